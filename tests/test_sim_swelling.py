"""Swelling tissue: free without stress, confined with pressure, in time with heart and breath."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from boxes import base_held, box, hold
from oracle import EVERY_LAW, tissue

from sim.accuracy import TRAIN, Accuracy
from sim.anatomy import Anatomy
from sim.bodies.meshfile import read_anatomy
from sim.compile import compile_problem
from sim.discretisation.problem import Problem
from sim.discretisation.space import discretise
from sim.discretisation.term import Cases
from sim.effects import Elasticity, Held, Pulsation, Resection, Slide, Wave
from sim.elements import ELEMENTS
from sim.errors import InputError
from sim.fem import Fem
from sim.geometry.surface import normalise_vectors
from sim.geometry.tetmesh import TetMesh
from sim.loads import Loads, Resected
from sim.material import Tissue
from sim.resected_fem import build_fem
from sim.runtime.device import find_device

MESH = box((2, 2, 2), 0.1, distortion=0.15)
TIGHT = Accuracy(tolerance=1e-10)
STILL = Wave(0.2, 0.0)
SERIES = ((0.4, 0.5), (0.3, 5.0))
TEMPLATE = Path(__file__).parents[1] / "scenes" / "data" / "template.vtu"


def at(*times: float) -> Loads:
    """Nothing acts; (B,) times [s]."""
    return Loads((), np.array(times))


def posed(made_of: Tissue, pulsation: Pulsation, element: str, time: float) -> tuple[Problem, np.ndarray]:
    """A box at a time, and its nodes (N, 3) [m]."""
    space = discretise(MESH, element)
    effects = (Elasticity(made_of), Held(), pulsation)
    problem = compile_problem(effects, base_held(MESH), find_device("cpu", "float64"), space)
    problem.begin(Cases(at(time), np.zeros(1)))
    return problem, space.nodes


def forces(problem: Problem, motion: np.ndarray) -> np.ndarray:
    """(N, 3) [N] that a motion (N, 3) [m] takes."""
    return problem.gradient(problem.device.upload(motion.reshape(-1, 1))).numpy().reshape(-1, 3)


@pytest.mark.parametrize("theta", [1e-6, 0.3, -0.3])
@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("law", EVERY_LAW)
def test_free_swelling_has_no_stress(law: str, element: str, theta: float) -> None:
    pulsation = Pulsation(Wave(1.0, abs(theta)), STILL)
    problem, nodes = posed(tissue(law), pulsation, element, 0.25 if theta > 0.0 else 0.75)
    wider = np.expm1(np.log1p(theta) / 3.0)
    held = np.linalg.norm(forces(problem, 0.0 * nodes))
    assert held > 0.0
    assert np.linalg.norm(forces(problem, wider * nodes)) < 1e-9 * held


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("law", ["neo-hookean", "ogden"])
def test_block_on_rollers_swells_by_the_cube_root(law: str, element: str) -> None:
    """It slides along the three planes through a corner. Relaxing tissue agrees with elastic tissue, at any time."""
    anatomy = hold(MESH, MESH.nodes < 1e-9)
    for made_of in (tissue(law), replace(tissue(law), prony=SERIES)):
        fem = Fem(
            anatomy, [Elasticity(made_of), Held(), Pulsation(Wave(0.25, 0.3), STILL)], TIGHT, "cpu", None, element
        )
        answer = fem.deform(at(1.0, 3.0))
        wider = np.cbrt([1.3, 0.7]) - 1.0
        np.testing.assert_allclose(answer.displacement, wider[:, None, None] * MESH.nodes, atol=1e-10)


@pytest.mark.parametrize("made_of", [tissue("stable-neo-hookean"), replace(tissue("ogden"), prony=SERIES)])
@pytest.mark.parametrize("element", ELEMENTS)
def test_confined_swelling_presses_with_the_bulk_modulus(element: str, made_of: Tissue) -> None:
    """-K theta, uniform, for any relaxation: only the shape relaxes."""
    problem, nodes = posed(made_of, Pulsation(Wave(0.125, 1e-6), STILL), element, 2.0)
    mu, lam = made_of.lame
    stress = forces(problem, 0.0 * nodes).T @ nodes / MESH.volumes.sum()
    np.testing.assert_allclose(stress, -1e-6 * (lam + 2.0 * mu / 3.0) * np.eye(3), atol=1e-11 * lam)


def test_swelling_follows_heart_and_breath_in_time() -> None:
    """Nothing at t = 0; heart and breath add up, and repeat after their common period."""
    fem = Fem(
        base_held(MESH),
        [Elasticity(), Held(), Pulsation(Wave(1.0, 0.01), Wave(0.25, 0.02))],
        TIGHT,
        "cpu",
        element="p1",
    )
    answer = fem.deform(at(0.0, 0.3, 1.3, 4.3))
    assert not answer.displacement[0].any()
    assert all(outcome.good for outcome in answer.outcome)
    size = np.abs(answer.displacement[1]).max()
    np.testing.assert_allclose(answer.displacement[3], answer.displacement[1], atol=1e-8 * size)
    assert np.abs(answer.displacement[2] - answer.displacement[1]).max() > 0.1 * size
    swelling = Pulsation(Wave(1.0, 0.01), Wave(0.25, 0.02)).compute_swelling(np.array([0.0, 0.25, 1.0, 3.0]))
    np.testing.assert_allclose(swelling, [0.0, 0.01 + 0.02 * np.sin(np.pi / 8.0), 0.02, -0.02], atol=1e-15)


def test_only_selected_regions_swell() -> None:
    """The lower half pushes the upper one up, which keeps its volume."""
    mesh = box((2, 2, 2), 0.1)
    upper = (mesh.nodes[mesh.tets].mean(axis=1)[:, 2] > 0.05).astype(int)
    anatomy = base_held(TetMesh(mesh.nodes, mesh.tets, upper))
    waves = Wave(1.0, 0.1), STILL
    swollen = []
    for regions in (None, (0,), (1,)):
        fem = Fem(
            anatomy, [Elasticity(tissue("linear")), Held(), Pulsation(*waves, regions)], TIGHT, "cpu", element="p1"
        )
        moved = mesh.nodes + fem.deform(at(0.25)).displacement[0]
        corners = moved[mesh.tets]
        volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6.0
        swollen.append([volume[upper == half].sum() / mesh.volumes[upper == half].sum() - 1.0 for half in (0, 1)])
    every, lower, upper_alone = np.array(swollen)
    assert every.min() > 0.03
    assert lower[0] > 0.03 and abs(lower[1]) < 0.01
    assert upper_alone[1] > 0.03 and abs(upper_alone[0]) < 0.02


def closed(anatomy: Anatomy) -> Anatomy:
    """The skull without an opening: there too the brain slides."""
    mesh = anatomy.mesh
    a, b, c = np.moveaxis(mesh.nodes[mesh.surface], 1, 0)
    facing = np.zeros_like(mesh.nodes)
    np.add.at(facing, mesh.surface, np.cross(b - a, c - a)[:, None])
    open_to = (facing != 0.0).any(axis=1) & ~anatomy.fixed.any(axis=1) & ~anatomy.slide_normal.any(axis=1)
    normal = np.where(open_to[:, None], normalise_vectors(facing), anatomy.slide_normal)
    return replace(anatomy, slide_normal=normal)


def test_pulsation_at_craniotomy_has_observed_amplitude() -> None:
    """Peak to peak 0.3 to 0.8 mm in the opening; with a closed skull less than a third of that."""
    anatomy = read_anatomy(TEMPLATE)
    swings = []
    for body in (anatomy, closed(anatomy)):
        fem = Fem(body, [Elasticity(), Held(), Slide(), Pulsation()], TRAIN, "cpu", element="p1")
        times = np.array([1.25, 3.75])  # where heart and breath are both at their utmost
        answer = fem.deform(Loads((), times))
        assert all(outcome.good for outcome in answer.outcome)
        swings.append(np.linalg.norm(np.diff(answer.displacement, axis=0)[0], axis=1))
    opening = (closed(anatomy).slide_normal != anatomy.slide_normal).any(axis=1)
    assert 3e-4 < swings[0][opening].max() < 8e-4
    assert swings[0].max() == swings[0][opening].max()
    assert swings[1].max() < 0.3 * swings[0].max()


def absent() -> object:
    return Fem(base_held(MESH), [Elasticity(), Held(), Pulsation(regions=(0, 7))], TIGHT, "cpu", element="p1")


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: Wave(0.0, 1e-3), r"Wave\.frequency is 0\.0 Hz: give a positive"),
        (lambda: Wave(1.0, -1e-3), r"Wave\.amplitude is -0\.001: must be a volume fraction from 0 to 0\.3"),
        (lambda: Wave(1.0, 0.5), r"amplitude is 0\.5"),
        (lambda: Pulsation(regions=()), "Pulsation has no regions"),
        (absent, r"Pulsation is given for region 7, but the mesh has the regions \[0\]"),
    ],
)
def test_invalid_pulsation_arguments_are_rejected(build: Callable[[], object], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        build()


def test_completely_resected_region_stops_swelling() -> None:
    region = (np.arange(len(MESH.tets)) == 0).astype(int)
    body = base_held(replace(MESH, region=region))
    effects = [Elasticity(), Held(), Pulsation(regions=(1,)), Resection(((0,),))]
    asked = Loads((Resected(np.array([0, 1])),), np.full(2, 0.25))
    answer = build_fem(body, effects, TIGHT, "cpu").deform(asked)
    assert answer.displacement[0].any() and not answer.displacement[1].any()
