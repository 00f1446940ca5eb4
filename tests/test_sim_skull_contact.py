"""Contact with the skull: pressure where tissue touches it, no force where tissue separates."""

from functools import cache

import numpy as np
import pytest
from boxes import box, hold, top_forces

from sim.accuracy import REFERENCE
from sim.anatomy import Anatomy
from sim.deformation import Deformation
from sim.discretisation.term import Cases
from sim.effects import Effect, Elasticity, Held, NodalForce, SkullContact, Slide
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads, Nodal
from sim.material import Material
from sim.runtime.device import find_device
from sim.terms.contact.skull_contact import Skull
from sim.terms.contact.skull_surface import BONE_SETTINGS, Bone, compute_curvature

TISSUE = Material("neo-hookean", 3000.0, 0.45)
MESH = box((4, 4, 4), 0.05)
TOP = MESH.nodes[:, 2] > 0.05 - 1e-9
LID = hold(MESH, MESH.nodes[:, 2] < 1e-9, TOP[:, None] * [0.0, 0.0, 1.0])
GAP = 3e-4


def lifted(force: float) -> Loads:
    """So many newtons [N] on the top, upwards."""
    return Loads((Nodal(top_forces(MESH, np.array([0.0, 0.0, force]))),))


@cache
def body(element: str, *effects: Effect) -> Fem:
    return Fem(LID, [Elasticity(TISSUE), Held(), NodalForce(), *effects], REFERENCE, "cpu", element=element)


def bears(fem: Fem, loads: Loads, found: Deformation) -> np.ndarray:
    """Force (N, 3) [N] of the skull on every node."""
    device = fem.problem.device
    out = device.allocate(fem.problem.rows, 1)
    fem.problem.barriers[0].add_gradient(device.upload(fem.guess(loads, found)), out)
    return -out.numpy().reshape(-1, 3)


@pytest.mark.parametrize("element", ["p1", "smoothed", "p2"])
@pytest.mark.parametrize("force", [0.2, 2.0, 20.0])
def test_pressure_and_gap_are_complementary(element: str, force: float) -> None:
    """d > 0, p >= 0 along the normal alone, and p d at most what the barrier leaves: 1.25 mu a, with its reach a."""
    fem = body(element, SkullContact(GAP))
    found = fem.deform(lifted(force))
    assert found.outcome[0].good
    skull = bears(fem, lifted(force), found)
    space = fem.space
    wall = space.nodes[:, 2] > 0.05 - 1e-9
    np.testing.assert_array_equal(skull[~wall], 0.0)
    np.testing.assert_array_equal(skull[:, :2], 0.0)
    u = fem.guess(lifted(force), found).reshape(-1, 3)
    d, pressure = GAP - u[wall, 2], -skull[wall, 2]
    assert d.min() > 0.0
    assert pressure.min() >= 0.0
    assert pressure.sum() > 0.5 * force
    corner = np.unique(space.surface[:, :3]) if element == "p2" else None
    area = 0.05**2 / wall.sum() if corner is None else 0.05**2
    most = 4.0 * area if corner is None else area
    assert (pressure * d).max() <= 1.25 * TISSUE.lame[0] * BONE_SETTINGS.activation * most


@pytest.mark.parametrize("element", ["p1", "p2"])
def test_skull_never_pulls_on_tissue(element: str) -> None:
    """Tissue that separates from the skull moves as without a skull."""
    away = body(element, SkullContact(GAP)).deform(lifted(-0.5))
    free = body(element).deform(lifted(-0.5))
    np.testing.assert_allclose(away.displacement, free.displacement, atol=1e-8 * np.abs(free.displacement).max())


def test_tissue_pressed_on_skull_agrees_with_slide() -> None:
    """Under 20 N the lid is where `Slide` keeps it, except for the gap."""
    touching = body("p1", SkullContact(1e-5)).deform(lifted(20.0))
    kept = body("p1", Slide()).deform(lifted(20.0))
    assert np.abs(touching.displacement - kept.displacement).max() < 1.1e-5


def test_zero_load_with_skull_gives_zero_displacement() -> None:
    np.testing.assert_array_equal(body("p1", SkullContact(GAP)).deform(lifted(0.0)).displacement, 0.0)


def test_undeformed_start_keeps_default_skull_gap_limit() -> None:
    """The limit is that of a solution without a start: a body at rest does not predict the next equilibrium."""
    skull, rest = body("p1", SkullContact(GAP)).problem.barriers[0], np.zeros((1, len(MESH.nodes), 3))

    def far(displacement: np.ndarray | None, restarted: np.ndarray | None = None) -> float:
        cases = Cases(lifted(1.0), np.zeros(1), displacement=displacement, restarted=restarted)
        return float(skull.compute_path_in_gaps(cases)[0])

    assert far(None) == far(rest) == far(rest + 1e-4, np.ones(1, bool)) > 10.0 * far(rest + 1e-4)


def test_skull_curvature_agrees_with_sphere_and_plane() -> None:
    rng = np.random.default_rng(3)
    normal = rng.normal(size=(800, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    exact = (np.eye(3) - normal[:, :, None] * normal[:, None, :]) / 0.07
    assert np.abs(compute_curvature(0.07 * normal, normal) - exact).max() < 0.1 / 0.07
    hollow = compute_curvature(-0.07 * normal, normal)
    np.testing.assert_allclose(hollow, 0.0, atol=1e-9)
    flat = np.column_stack([rng.uniform(size=(50, 2)), np.zeros(50)])
    np.testing.assert_allclose(compute_curvature(flat, np.tile([0.0, 0.0, 1.0], (50, 1))), 0.0, atol=1e-12)


def test_rotating_body_slides_along_a_round_skull() -> None:
    """Rotated by a twentieth, a point of a ball is as near to a round wall as before, but not to a plane."""
    n, R, angle = np.array([0.6, 0.0, 0.8]), 0.07, 0.05
    turn = np.array([[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]])
    u = R * (turn @ n - n) + 3e-5 * turn @ n
    device = find_device("cpu", "float64")
    round_wall = (np.eye(3) - np.outer(n, n)) / R

    def force(bend: np.ndarray, at: np.ndarray) -> np.ndarray:
        one, none = np.ones(1), np.zeros((1, 3))
        skull = Skull(
            Bone(
                nodes=np.array([0]),
                normal=n[None],
                curvature=bend[None],
                inside_distance=-one,
                inward=none,
                activation=5e-5 * one,
                area=1e-4 * one,
                gap=5e-5,
                edge_radius=0.0,
            ),
            1,
            1000.0,
            device,
        )
        out = device.allocate(3, 1)
        skull.add_gradient(device.upload(at[:, None]), out)
        return out.numpy()[:, 0]

    before, after = force(round_wall, 3e-5 * n), force(round_wall, u)
    np.testing.assert_allclose(np.linalg.norm(after), np.linalg.norm(before), rtol=0.02)
    np.testing.assert_allclose(after @ (turn @ n), np.linalg.norm(after), rtol=1e-3)
    np.testing.assert_array_equal(force(np.zeros((3, 3)), u), 0.0)


@pytest.mark.parametrize(
    ("effects", "sentence"),
    [((Slide(), SkullContact()), "Slide and SkullContact"), ((SkullContact(), SkullContact(2e-4)), "2 times")],
)
def test_contradicting_skull_effects_are_rejected(effects: tuple[Effect, ...], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        Fem(LID, [Elasticity(), Held(), *effects], REFERENCE, "cpu", element="p1")


def test_skull_without_nodes_to_touch_is_rejected() -> None:
    bare = Anatomy(MESH, LID.fixed, np.zeros_like(LID.slide_normal), LID.craniotomy)
    with pytest.raises(InputError, match="SkullContact finds no node"):
        Fem(bare, [Elasticity(), Held(), SkullContact()], REFERENCE, "cpu", element="p1")


def test_body_held_by_skull_contact_alone_is_rejected() -> None:
    with pytest.raises(InputError, match="hold at least three nodes"):
        Fem(
            hold(MESH, np.zeros(len(TOP), bool), LID.slide_normal),
            [Elasticity(), Held(), SkullContact()],
            REFERENCE,
            element="p1",
        )


def test_skull_gap_must_be_positive() -> None:
    with pytest.raises(InputError, match="gap is 0"):
        SkullContact(0.0)
