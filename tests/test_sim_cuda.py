"""Results on CUDA against the CPU, with the preconditioner of each."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from oracle import EVERY_LAW, tissue

from scenes.script.shipped_files import get_template_path
from sim.accuracy import LIVE, TRAIN, Accuracy
from sim.bodies.meshfile import read_anatomy
from sim.effects import (
    Elasticity,
    Gravity,
    Held,
    Inertia,
    Pulsation,
    SkullContact,
    Slide,
    ToolContact,
    ToolDisplacement,
    ToolForce,
)
from sim.elements import ELEMENTS
from sim.fem import Fem
from sim.linalg.pcg import BlockJacobi
from sim.loads import Displaced, Loads, Touching, build_posture, push
from sim.material import Material
from sim.strategy.frame_sequence import DeviceWarmStart
from sim.tools import Ball, Spatula
from surrogate.data.tool_loads import draw

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device here")]
BOUND = {"float64": 1e-6, "float32": 2e-3}
"""Largest difference over the largest motion: both stop at a residual, not at the same iterate."""


def pushes():
    """Up to 0.26 N: 0.31 N turn quadratic stable tissue over, which has several equilibria then."""
    x = np.linspace(-8e-3, 8e-3, 7)
    point = np.stack([x, x[::-1] / 2.0, np.zeros(7)], axis=1)
    force = np.linspace(0.02, 0.25, 7)[:, None] * np.array([[0.3, 0.1, -1.0]])
    return push(point, force, 7e-3)


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("law", EVERY_LAW)
def test_cuda_agrees_with_cpu_for_batch_of_pushes(box, law, element, precision):
    accuracy = replace(Accuracy(1e-8) if precision == "float64" else TRAIN, limit_strain=False)
    effects = (Elasticity(tissue(law)), Held(), ToolForce())
    on_cpu = Fem(box, effects, accuracy, "cpu", element=element).deform(pushes())
    on_cuda = Fem(box, effects, accuracy, "cuda", element=element).deform(pushes())
    assert all(outcome.good for outcome in on_cuda.outcome)
    off = np.abs(on_cpu.displacement - on_cuda.displacement).max()
    assert off <= BOUND[precision] * np.abs(on_cpu.displacement).max()


@pytest.mark.parametrize("element", ELEMENTS)
def test_cuda_reaction_of_moved_footprint_agrees_with_cpu(box, element):
    loads = Loads((Displaced(np.zeros((1, 3)), np.array([[1e-3, 0.0, -4e-3]]), np.array([7e-3])),))
    effects = (Elasticity(), Held(), Slide(), ToolDisplacement())
    on_cpu, on_cuda = (
        Fem(box, effects, Accuracy(1e-8), name, element=element).deform(loads) for name in ("cpu", "cuda")
    )
    np.testing.assert_allclose(on_cuda.reaction, on_cpu.reaction, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("element", ELEMENTS)
def test_cuda_agrees_with_cpu_for_batch_of_postures(box, element, precision):
    """Fluid levels between nodes of the box, with a tool; includes the posture of the scan."""
    accuracy = Accuracy(1e-8) if precision == "float64" else TRAIN
    down, top = np.array([0.3, 0.0, -1.0]), float(box.mesh.nodes[:, 2].max())
    drained = build_posture(down, top - np.linspace(0.001, 0.04, 7))
    loads = Loads((*pushes().causes, *drained.causes))
    effects = (Elasticity(), Held(), ToolForce(), Gravity())
    on_cpu, on_cuda = (Fem(box, effects, accuracy, name, element=element) for name in ("cpu", "cuda"))
    expected, found = on_cpu.deform(loads), on_cuda.deform(loads)
    assert all(outcome.good for outcome in found.outcome)
    off = np.abs(expected.displacement - found.displacement).max()
    assert off <= BOUND[precision] * np.abs(expected.displacement).max()
    scan = build_posture(np.array(Gravity().direction), np.full(7, 1.0))
    assert not on_cuda.deform(scan, found).displacement.any()


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("element", ["p1", "smoothed"])
@pytest.mark.parametrize(
    ("law", "moving"), [("ogden", ()), ("ogden", (Inertia(damping=2.0),)), ("stable-neo-hookean", ())]
)
def test_cuda_time_steps_agree_with_cpu(box, law, moving, element, precision):
    """Tissue that relaxes and swells, with and without mass; steps of two lengths in one batch."""
    accuracy = Accuracy(1e-8) if precision == "float64" else TRAIN
    made_of = replace(tissue(law), prony=((0.4, 0.5), (0.3, 5.0)))
    effects = (Elasticity(made_of), Held(), ToolForce(), Pulsation(), *moving)
    step = np.array([0.02, 0.02, 0.02, 0.02, 0.3, 0.3, 0.3])
    answers = []
    for name in ("cpu", "cuda"):
        fem, answer = Fem(box, effects, accuracy, name, element=element), None
        for number in range(1, 4):
            answer = fem.deform(Loads(pushes().causes, number * step), answer)
            assert all(outcome.good for outcome in answer.outcome)
        answers.append(answer)
    on_cpu, on_cuda = answers
    off = np.abs(on_cpu.displacement - on_cuda.displacement).max()
    assert off <= 3.0 * BOUND[precision] * np.abs(on_cpu.displacement).max()
    assert set(on_cpu.memory) >= {f"viscoelasticity {law}" + (" of shape" if element == "smoothed" else "")}


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("element", ["p1", "smoothed"])
def test_cuda_agrees_with_cpu_for_batch_of_moved_tools(box, element, precision):
    """A ball and a blade in each case, without contact, in contact and deep; then a second step from there."""
    accuracy = Accuracy(1e-7) if precision == "float64" else TRAIN
    tools = (Ball(5e-3), Spatula(8e-3, 14e-3, 1.5e-3))
    effects = (Elasticity(Material("neo-hookean", 3000.0, 0.45)), Held(), ToolContact(tools))
    pose = np.tile(np.eye(4), (5, 2, 1, 1))
    pose[:, 0, :3, 3], pose[:, 1, :3, 3] = [-8e-3, 1e-3, 0.0], [9e-3, -2e-3, 0.0]
    pose[:, :, 2, 3] = -np.array([-2e-3, 0.0, 1e-3, 2e-3, 3e-3])[:, None]
    on = pose.copy()
    on[:, :, 0, 3] += 1e-3
    answers = []
    for name in ("cpu", "cuda"):
        fem = Fem(box, effects, accuracy, name, element=element)
        answers.append(fem.deform(Loads((Touching(on),)), fem.deform(Loads((Touching(pose),)))))
    on_cpu, on_cuda = answers
    assert all(outcome.good for outcome in on_cuda.outcome)
    size = np.abs(on_cpu.displacement).max()
    assert np.abs(on_cpu.displacement - on_cuda.displacement).max() <= 3.0 * BOUND[precision] * size
    force = np.abs(on_cpu.reaction).max()
    assert np.abs(on_cpu.reaction - on_cuda.reaction).max() <= 10.0 * BOUND[precision] * force
    assert not on_cuda.displacement[0].any() and force > 0.01


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("element", ["p1", "smoothed"])
def test_cuda_contact_frames_agree_with_cpu(box, element, precision):
    """One tool moves down, slides and lifts: contact descent with separate steps."""
    accuracy = Accuracy(1e-7) if precision == "float64" else TRAIN
    effects = (Elasticity(Material("neo-hookean", 3000.0, 0.45)), Held(), ToolContact((Ball(5e-3),)))
    way = np.array([[0.0, 0.0, -1e-3], [1e-3, 0.0, -2e-3], [3e-3, 1e-3, -2e-3], [3e-3, 1e-3, 2e-3]])
    answers = {}
    for name in ("cpu", "cuda"):
        fem, answer = Fem(box, effects, accuracy, name, element=element), None
        for number, place in enumerate(way):
            pose = np.eye(4)
            pose[:3, 3] = place
            answer = fem.deform(Loads((Touching(pose[None, None]),)), answer)
            assert answer.outcome[0].good
            answers[name, number] = answer
    for number in range(len(way)):
        on_cpu, on_cuda = answers["cpu", number], answers["cuda", number]
        size = np.abs(answers["cpu", 1].displacement).max()
        assert np.abs(on_cpu.displacement - on_cuda.displacement).max() <= 3.0 * BOUND[precision] * size
    assert not answers["cuda", len(way) - 1].displacement.any()


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("element", ["p1", "smoothed"])
def test_cuda_skull_contact_agrees_with_cpu(box, element, precision):
    """The box's lower side rests on bone, its weight reversed in half of the cases."""
    accuracy = Accuracy(1e-7) if precision == "float64" else TRAIN
    height = box.mesh.nodes[:, 2]
    low = height < height.min() + 1e-9
    body = replace(box, fixed=box.fixed & ~low[:, None], slide_normal=np.outer(low, [0.0, 0.0, -1.0]))
    effects = (Elasticity(Material("neo-hookean", 1000.0, 0.45)), Held(), Gravity((0.0, 1.0, 0.0)), SkullContact())
    way = np.array([[0.0, 0.0, -1.0], [0.0, 0.5, 1.0], [0.3, 0.0, -1.0], [0.0, 0.0, 1.0]])
    loads = build_posture(way, -1.0)
    on_cpu, on_cuda = (Fem(body, effects, accuracy, name, element=element).deform(loads) for name in ("cpu", "cuda"))
    assert all(outcome.good for outcome in on_cuda.outcome)
    size = np.abs(on_cpu.displacement).max()
    assert np.abs(on_cpu.displacement - on_cuda.displacement).max() <= 3.0 * BOUND[precision] * size
    drop = on_cuda.displacement[:, low, 2]
    assert drop.min() > -1e-4 and drop[3].max() > 2e-4


def test_cuda_block_jacobi_agrees_with_inverse(box):
    fem = Fem(box, (Elasticity(), Held(), ToolForce()), Accuracy(1e-8), "cuda", element="p1")
    reference = fem.deform(pushes()).displacement
    plain = Fem(box, (Elasticity(), Held(), ToolForce()), Accuracy(1e-8, inner=4000), "cuda", element="p1")
    plan = replace(plain.plan, batch_solver=None)
    plain.strategy = replace(plain.strategy, preconditioner=BlockJacobi(plain.problem.device), plan=plan)
    np.testing.assert_allclose(plain.deform(pushes()).displacement, reference, atol=1e-6 * np.abs(reference).max())


def test_cuda_local_solution_agrees_with_whole_body():
    """More columns than one buffer holds, so that buffers change."""
    anatomy = read_anatomy(get_template_path())
    effects, loads = (Elasticity(), Held(), Slide(), ToolForce()), draw("mixed", anatomy, 150, 3)
    fem = Fem(anatomy, effects, replace(TRAIN, limit_strain=False), "cuda", element="p1")
    found = fem.deform(loads)
    assert fem.strategy.build_batch_solver() is not None and all(outcome.good for outcome in found.outcome)
    assert (fem.residual(loads, found) <= 1.5 * TRAIN.tolerance).all()
    fem.strategy = replace(fem.strategy, plan=replace(fem.plan, batch_solver=None))
    plain = fem.deform(loads)
    assert np.median(found.iterations) < 0.7 * np.median(plain.iterations)
    largest = np.abs(plain.displacement).max(axis=(1, 2), keepdims=True)
    assert (np.abs(found.displacement - plain.displacement) <= BOUND["float32"] * largest).all()


def test_cuda_frame_sequence_agrees_with_cpu(box):
    """An older frame as start gives its former result: its data were copied from the device in time."""
    effects = (Elasticity(), Held(), ToolForce())
    loads = [push(np.array([x, 0.0, 0.0]), np.array([0.0, 0.05, -0.4]), 7e-3) for x in np.linspace(-4e-3, 4e-3, 8)]
    fem, host = Fem(box, effects, LIVE, "cuda", element="p1"), Fem(box, effects, LIVE, "cpu", element="p1")
    answers, other = [fem.deform(loads[0])], host.deform(loads[0])
    for load in loads[1:]:
        answers.append(fem.deform(load, answers[-1]))
        other = host.deform(load, other)
        assert isinstance(answers[-1].warm, DeviceWarmStart) and answers[-1].outcome == other.outcome
        off = np.abs(answers[-1].displacement - other.displacement).max()
        assert off <= 0.02 * np.abs(other.displacement).max()  # both stop at LIVE's residual
    np.testing.assert_allclose(fem.residual(loads[-1], answers[-1]), answers[-1].residual, rtol=0.05)
    for number in (3, 7):
        again = fem.deform(loads[number], answers[number - 1])
        largest = np.abs(again.displacement).max()
        np.testing.assert_allclose(again.displacement, answers[number].displacement, atol=1e-3 * largest)
        np.testing.assert_array_equal(again.iterations, answers[number].iterations)
