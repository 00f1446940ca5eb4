"""Gravity with changing posture and fluid level: cut elements, their weight, and a column under its weight."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from boxes import base_held, box, hold, quadratic

from sim.accuracy import Accuracy
from sim.anatomy import Anatomy
from sim.compile import compile_problem
from sim.discretisation.space import discretise
from sim.discretisation.term import Cases
from sim.effects import Elasticity, Gravity, Held, ToolForce
from sim.elements import ELEMENTS
from sim.errors import InputError
from sim.fem import Fem
from sim.geometry.tetmesh import TetMesh
from sim.loads import Loads, Posture, build_posture, push
from sim.material import Material
from sim.runtime.device import find_device
from sim.terms.gravity import cut_below_plane

G = 9.80665
DRY, FLUID = 1040.0 * G, 1007.0 * G  # [N/m^3]
DOWN = np.array([0.0, 0.0, -1.0])
UPRIGHT = Gravity(direction=(0.0, 0.0, -1.0))
TIGHT = Accuracy(tolerance=1e-11)
ROCK = Material("linear", 3000.0, 0.3)
HEIGHT = 0.1


def build_nodal_forces(
    mesh: TetMesh, element: str, loads: Loads, effect: Gravity = UPRIGHT
) -> tuple[np.ndarray, np.ndarray]:
    """Forces (B, N, 3) [N] of the term, and the rest positions (N, 3) of its nodes."""
    space, device = discretise(mesh, element), find_device("cpu", "float64")
    problem = compile_problem([Elasticity(), Held(), effect], base_held(mesh), device, space)
    problem.begin(Cases(loads, np.zeros(len(loads))))
    gradient = problem.gradient(device.allocate(problem.rows, len(loads))).numpy()
    return -gradient.T.reshape(len(loads), -1, 3), space.nodes


def mean_height_under(height: np.ndarray) -> np.ndarray:
    """Mean (n,) of min(h, 0) over tetrahedra, h linear with values (n, 4): a divided difference (Hermite, Genocchi)."""
    others = height[:, :, None] - height[:, None, :] + np.eye(4)
    return (np.where(height < 0.0, height**4, 0.0) / others.prod(axis=2)).sum(axis=1) / 4.0


def test_volume_below_plane_agrees_with_differences() -> None:
    """Shares, and the means of corner coordinates over them, which are slopes of the mean of min(h, 0)."""
    height = np.random.default_rng(1).normal(size=(400, 4))
    height = height[(height < 0.0).any(axis=1) & (height > 0.0).any(axis=1)]
    owner, parts = cut_below_plane(height)
    share, mean = np.abs(np.linalg.det(parts)), parts.mean(axis=1)
    found = np.stack([np.bincount(owner, share * mean[:, corner], len(height)) for corner in range(4)], axis=1)
    h = 1e-5 * np.eye(4)
    slope = [(mean_height_under(height + one) - mean_height_under(height - one)) / 2e-5 for one in h]
    np.testing.assert_allclose(found, np.stack(slope, axis=1), atol=1e-7)
    assert {int(count) for count in (height < 0.0).sum(axis=1)} == {1, 2, 3}


@pytest.mark.parametrize("level", [0.0, 1e-300, 0.02, 0.0371, 0.05, 0.0999, 0.1, 0.3])
@pytest.mark.parametrize("element", ELEMENTS)
def test_work_of_gravity_forces_agrees_with_weight(element: str, level: float) -> None:
    """For every motion that the elements represent exactly: uniform, linear in x and z, quadratic where possible."""
    mesh = box((3, 3, 3), HEIGHT, distortion=0.2)
    force, nodes = build_nodal_forces(mesh, element, build_posture(3.0 * DOWN, level))
    wet, area = min(level, HEIGHT), HEIGHT**2
    for power in range(3 if element == "p2" else 2):
        # The scan was wet all over: what has drained weighs more by the fluid's own weight.
        work = FLUID * area * (HEIGHT ** (power + 1) - wet ** (power + 1)) / (power + 1)
        assert force[0, :, 2] @ nodes[:, 2] ** power == pytest.approx(-work, rel=1e-11, abs=1e-12)
    aside = FLUID * area * (HEIGHT - wet) * HEIGHT / 2.0
    assert force[0, :, 2] @ nodes[:, 0] == pytest.approx(-aside, rel=1e-11, abs=1e-12)
    assert not force[..., :2].any()


def test_weight_of_curved_elements_agrees_with_volume() -> None:
    mesh = quadratic(box((2, 2, 2), HEIGHT), curved=0.05)
    force, nodes = build_nodal_forces(mesh, "p2", build_posture(DOWN, -1.0))
    assert force[0, :, 2].sum() == pytest.approx(-FLUID * HEIGHT**3, rel=1e-12)
    assert force[0, :, 2] @ nodes[:, 2] == pytest.approx(-FLUID * HEIGHT**4 / 2.0, rel=1e-4)


def test_gravity_force_changes_with_rotation_of_head() -> None:
    """Immersed in both postures: the force acts along the new direction minus the old one."""
    way = np.array([0.6, 0.0, -0.8])
    force, _ = build_nodal_forces(box((2, 2, 2), HEIGHT), "p1", build_posture(1e-20 * way, 1.0))
    np.testing.assert_allclose(force[0].sum(axis=0), (DRY - FLUID) * HEIGHT**3 * (way - DOWN), rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize("element", ELEMENTS)
def test_gravity_forces_are_continuous_in_fluid_level(element: str) -> None:
    """Each of 81 steps of the level changes the force by the weight of the fluid between, across planes of the mesh."""
    mesh, levels = box((2, 2, 2), HEIGHT, distortion=0.2), np.linspace(0.0, HEIGHT, 82)
    force, _ = build_nodal_forces(mesh, element, build_posture(DOWN, levels))
    step = np.diff(force[:, :, 2], axis=0)
    slice_weight = FLUID * HEIGHT**2 * (levels[1] - levels[0])
    np.testing.assert_allclose(step.sum(axis=1), slice_weight, rtol=1e-9)
    most = 1.0 if element != "p2" else 2.0  # corner shapes of quadratic elements are negative in places
    assert np.abs(step).sum(axis=1).max() <= most * slice_weight * (1.0 + 1e-9)


def column(cells: int) -> Anatomy:
    """A column on rollers, 4 times as high as wide: no motion across its sides and its foot."""
    mesh = box((cells, cells, 4 * cells), HEIGHT)
    held = mesh.nodes < 1e-9
    held[:, :2] |= mesh.nodes[:, :2] > HEIGHT / 4.0 - 1e-9
    return hold(mesh, held)


def sunk(z: np.ndarray, level: float) -> np.ndarray:
    """u_z (V,) [m] of a column drained to `level`: M u'' = weight above it, none under it, u(0) = 0, u'(H) = 0."""
    mu, lam = ROCK.lame
    high = np.maximum(z, level)
    above = (high**2 - level**2) / 2.0 - HEIGHT * (high - level)
    return FLUID / (lam + 2.0 * mu) * (above - (HEIGHT - level) * np.minimum(z, level))


def errors_of_column(element: str, cells: int, level: float) -> np.ndarray:
    """The error (V,) of every node over the largest motion."""
    anatomy = column(cells)
    fem = Fem(anatomy, [Elasticity(ROCK), Held(), UPRIGHT], TIGHT, "cpu", element=element)
    found = fem.deform(build_posture(DOWN, level))
    assert found.outcome[0].good
    exact = sunk(anatomy.mesh.nodes[:, 2], level)
    wrong = found.displacement[0] - exact[:, None] * [0.0, 0.0, 1.0]
    return np.linalg.norm(wrong, axis=1) / np.abs(exact).max()


@pytest.mark.parametrize("level", [0.0, 0.025, 0.05])
def test_column_of_quadratic_elements_is_exact_under_gravity(level: float) -> None:
    """Its displacement is quadratic in z on either side of a level that lies between elements."""
    assert errors_of_column("p2", 1, level).max() < 1e-9


@pytest.mark.parametrize("level", [0.0, 0.042])
@pytest.mark.parametrize("element", ["p1", "smoothed"])
def test_column_of_linear_elements_converges_under_gravity(element: str, level: float) -> None:
    """At second order in the mean square, also with a level within elements."""
    errors = [np.sqrt((errors_of_column(element, cells, level) ** 2).mean()) for cells in (2, 4, 8)]
    assert errors[-1] < 0.002
    assert np.log2(errors[-2] / errors[-1]) > 1.7


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_posture_of_the_scan_causes_no_displacement(precision: str) -> None:
    """From rest and from another posture; a level above the body is equal to that of a full skull."""
    accuracy = Accuracy(tolerance=1e-4, precision=precision)  # pyright: ignore[reportArgumentType]
    scan = Gravity(direction=(0.0, -3.0, -4.0), csf_level=0.043)
    for effect, level in ((scan, scan.csf_level), (Gravity(direction=scan.direction), 0.2)):
        fem = Fem(base_held(box((2, 2, 2))), [Elasticity(), Held(), effect], accuracy, "cpu", element="p1")
        same = build_posture(0.5 * np.array(scan.direction), level)
        assert not fem.deform(same).displacement.any()
        elsewhere = fem.deform(build_posture(DOWN, 0.0))
        assert elsewhere.displacement.any()
        again = fem.deform(same, elsewhere)
        assert again.outcome[0].good
        assert not again.displacement.any()


def test_scaled_posture_scales_the_gravity_forces() -> None:
    turned = build_posture([[1.0, 0.0, 0.0], [0.0, 1.0, -1.0]], [0.04, 0.06])
    mesh = box((2, 2, 2))
    whole, _ = build_nodal_forces(mesh, "p1", turned)
    part, _ = build_nodal_forces(mesh, "p1", turned.scale(np.array([0.25, -2.0])))
    np.testing.assert_allclose(part, np.array([0.25, -2.0])[:, None, None] * whole, rtol=1e-14)


def test_postures_and_pushes_add_up_in_batches() -> None:
    """In small motions; a batch agrees with its cases solved separately."""
    fem = Fem(base_held(box((2, 2, 2))), [Elasticity(ROCK), Held(), ToolForce(), UPRIGHT], TIGHT, "cpu", element="p1")
    drained = build_posture(DOWN, [0.0, 0.03, 0.07])
    pushed = push(
        np.full((3, 3), [0.05, 0.05, 0.1]), np.array([[0.1, 0.0, -0.3], [0.0, 0.2, 0.0], [0.0, 0.0, -1.0]]), 0.02
    )
    both = Loads((*pushed.causes, *drained.causes))
    together = fem.deform(both).displacement
    summed = fem.deform(pushed).displacement + fem.deform(drained).displacement
    single = np.concatenate([fem.deform(both.select(np.array([row]))).displacement for row in range(3)])
    size = np.abs(together).max()
    np.testing.assert_allclose(together, summed, atol=1e-9 * size)
    np.testing.assert_allclose(together, single, atol=1e-9 * size)


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: Gravity(direction=(0.0, 0.0, 0.0)), "direction is .* not all zero"),
        (lambda: Gravity(direction=(0.0, math.inf, 0.0)), "direction is .* finite"),
        (lambda: Gravity(direction=(1.0, 0.0)), "direction is .* three"),  # pyright: ignore[reportArgumentType]
        (lambda: Gravity(csf_level=math.nan), "csf_level is NaN"),
        (lambda: Gravity(density=0.0), r"Gravity\.density is 0\.0 kg/m\^3"),
        (lambda: Gravity(csf_density=math.inf), r"Gravity\.csf_density is inf"),
        (lambda: build_posture([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]], 0.1), r"Posture\.direction has a row of zeros"),
        (lambda: build_posture(DOWN, math.inf), r"Posture\.csf_level .*finite"),
        (
            lambda: Loads((Posture(DOWN[None], np.zeros((1, 1)), np.ones(1)),)),
            r"csf_level has shape \(1, 1\): give \(B,\)",
        ),
    ],
)
def test_invalid_gravity_arguments_are_rejected(build: Callable[[], object], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        build()


def test_posture_without_gravity_effect_is_rejected() -> None:
    fem = Fem(base_held(box((1, 1, 1))), [Elasticity(), Held()], TIGHT, "cpu", element="p1")
    with pytest.raises(InputError, match="loads hold Posture, which no effect uses: add the effect Gravity"):
        fem.deform(build_posture(DOWN, 0.0))
