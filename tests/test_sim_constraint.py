"""Held, prescribed and sliding nodes, and footprints that a tool moves."""

import numpy as np
import pytest
from boxes import box, hold

from sim.accuracy import Accuracy
from sim.anatomy import Anatomy
from sim.deformation import Deformation
from sim.discretisation.constraint import Constraint
from sim.discretisation.footprint import compute_footprint_weights
from sim.effects import Effect, Elasticity, Held, NodalForce, Slide, ToolDisplacement, ToolForce
from sim.elements import ELEMENTS
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Cause, Displaced, Loads, Nodal, Prescribed, Pushed
from sim.material import Material
from sim.runtime.device import Device

MESH = box((3, 3, 3), 0.1, distortion=0.1)
BASE = MESH.nodes[:, 2] < 1e-9
TOP = MESH.nodes[:, 2] > 0.1 - 1e-9
COUNT = len(MESH.nodes)
RNG = np.random.default_rng(21)
TIGHT = Accuracy(tolerance=1e-10)
SOFT = Elasticity(Material("stable-neo-hookean", 3000.0, 0.45))


def mixed() -> tuple[np.ndarray, np.ndarray]:
    """Held (V, 3) and normals (V, 3): whole nodes, single components, sliding nodes, and nodes that are both."""
    held = np.repeat(BASE[:, None], 3, axis=1)
    held[RNG.random((COUNT, 3)) < 0.1] = True
    normal = np.zeros((COUNT, 3))
    sliding = TOP | (RNG.random(COUNT) < 0.2)
    normal[sliding] = RNG.normal(size=(sliding.sum(), 3))
    normal[sliding] /= np.linalg.norm(normal[sliding], axis=1, keepdims=True)
    return held, normal


def constraint(device: Device, footprint: bool, columns: int = 3) -> Constraint:
    held, normal = mixed()
    out = Constraint(held, normal, device)
    weight = RNG.random((COUNT, columns)) if footprint else None
    out.begin(RNG.normal(size=(3 * COUNT, columns)), weight, RNG.normal(size=(3, columns)) if footprint else None)
    return out


def projected(of: Constraint, device: Device, v: np.ndarray) -> np.ndarray:
    array = device.upload(v)
    of.project(array)
    return array.numpy()


def solve(
    anatomy: Anatomy, effects: list[Effect], *causes: Cause, accuracy: Accuracy = TIGHT, element: str = "p1"
) -> Deformation:
    found = Fem(anatomy, [SOFT, *effects], accuracy, "cpu", element=element).deform(Loads(causes))
    assert all(outcome.good for outcome in found.outcome)
    return found


@pytest.mark.parametrize("footprint", [False, True])
class TestProjection:
    def test_projection_is_idempotent(self, device: Device, footprint: bool) -> None:
        of, v = constraint(device, footprint), RNG.normal(size=(3 * COUNT, 3))
        once = projected(of, device, v)
        np.testing.assert_allclose(projected(of, device, once), once, atol=1e-12)

    def test_projection_is_symmetric_and_reduces_norm(self, device: Device, footprint: bool) -> None:
        of = constraint(device, footprint)
        v, w = RNG.normal(size=(2, 3 * COUNT, 3))
        Pv, Pw = projected(of, device, v), projected(of, device, w)
        np.testing.assert_allclose((w * Pv).sum(axis=0), (Pw * v).sum(axis=0), atol=1e-10)
        assert (np.linalg.norm(Pv, axis=0) < np.linalg.norm(v, axis=0)).all()

    def test_projection_removes_constrained_components(self, device: Device, footprint: bool) -> None:
        of = constraint(device, footprint)
        held, normal = of.fixed, of.normal
        v = projected(of, device, RNG.normal(size=(3 * COUNT, 3))).reshape(COUNT, 3, 3)
        assert not v[held].any()
        np.testing.assert_allclose(np.einsum("ni,nic->nc", normal, v), 0.0, atol=1e-12)

    def test_closed_gap_meets_the_constraints(self, device: Device, footprint: bool) -> None:
        of = constraint(device, footprint)
        u = RNG.normal(size=(3 * COUNT, 3))
        gap, size = of.close_gap(device.upload(u))
        np.testing.assert_array_equal(size, np.abs(gap.numpy()).max(axis=0))
        _, left = of.close_gap(device.upload(u + gap.numpy()))
        assert left.max() < 1e-12 * size.max()
        # The least such motion: nothing in it is free.
        np.testing.assert_allclose(projected(of, device, gap.numpy()), 0.0, atol=1e-11)

    def test_selected_columns_keep_values_weights_and_targets(self, device: Device, footprint: bool) -> None:
        of, u = constraint(device, footprint), RNG.normal(size=(3 * COUNT, 3))
        gap = of.close_gap(device.upload(u))[0].numpy()
        free = projected(of, device, u)
        of.keep(np.array([2, 0]))
        np.testing.assert_array_equal(of.close_gap(device.upload(u[:, [2, 0]]))[0].numpy(), gap[:, [2, 0]])
        np.testing.assert_array_equal(projected(of, device, u[:, [2, 0]]), free[:, [2, 0]])


def test_constraint_basis_spans_range_of_projection(device: Device) -> None:
    of = constraint(device, False, columns=1)
    basis = of.build_basis().toarray()
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-12)
    v = RNG.normal(size=(3 * COUNT, 1))
    np.testing.assert_allclose(basis @ (basis.T @ v), projected(of, device, v), atol=1e-12)


def test_sliding_nodes_stay_in_their_plane() -> None:
    tilted = np.array([0.6, 0.0, 0.8])
    anatomy = hold(MESH, BASE, np.where(TOP[:, None], tilted, 0.0))
    force = np.zeros((1, COUNT, 3))
    force[0, TOP] = [0.02, 0.03, -0.05]
    found = solve(anatomy, [Held(), Slide(), NodalForce()], Nodal(force))
    u = found.displacement[0]
    assert np.abs(u[TOP] @ tilted).max() < 1e-15
    assert not u[BASE].any()
    assert np.linalg.norm(u[TOP], axis=1).min() > 1e-4  # tangentially free


def test_slide_normals_without_slide_effect_are_ignored() -> None:
    anatomy = hold(MESH, BASE, np.where(TOP[:, None], [0.0, 0.0, 1.0], 0.0))
    force = np.zeros((1, COUNT, 3))
    force[0, TOP, 2] = -0.05
    assert solve(anatomy, [Held(), NodalForce()], Nodal(force)).displacement[0, TOP, 2].max() < -1e-4


def test_components_are_prescribed_separately_in_each_case() -> None:
    """One mask, three load cases with other values; entries that are not held are ignored."""
    held = np.repeat(BASE[:, None], 3, axis=1)
    held[TOP, 2] = True
    corner = int(np.flatnonzero(TOP)[0])
    held[corner, 0] = True
    value = RNG.normal(size=(3, COUNT, 3)) * 1e-3
    found = solve(hold(MESH, held), [Held()], Prescribed(value))
    np.testing.assert_allclose(found.displacement[:, held], value[:, held], atol=1e-15)
    free = ~held
    assert (np.abs(found.displacement[:, free] - value[:, free]) > 1e-12).all()
    for row in range(3):
        alone = solve(hold(MESH, held), [Held()], Prescribed(value[[row]]))
        np.testing.assert_allclose(alone.displacement[0], found.displacement[row], atol=1e-10)


@pytest.mark.parametrize("law", ["linear", "stable-neo-hookean"])
def test_sliding_and_partly_held_node_obeys_both_constraints(law: str) -> None:
    """A prescribed component moves a sliding node along its plane; the normal motion is zero."""
    normal = np.array([0.6, 0.0, 0.8])
    held = np.repeat(BASE[:, None], 3, axis=1)
    held[TOP, 0] = True
    anatomy = hold(MESH, held, np.where(TOP[:, None], normal, 0.0))
    value = np.zeros((1, COUNT, 3))
    value[0, TOP, 0] = 2e-3
    found = Fem(anatomy, [Elasticity(Material(law, 3000.0, 0.4)), Held(), Slide()], TIGHT, "cpu", element="p1")
    u = found.deform(Loads((Prescribed(value),))).displacement[0]
    np.testing.assert_allclose(u[TOP, 0], 2e-3, atol=1e-15)
    np.testing.assert_allclose(u[TOP] @ normal, 0.0, atol=1e-15)


POINT = np.array([[0.05, 0.05, 0.1], [0.06, 0.04, 0.1], [0.05, 0.0, 0.05]])
MOTION = np.array([[0.0, 0.0, -4e-3], [3e-3, 1e-3, -6e-3], [1e-3, 5e-3, 2e-3]])
RADIUS = np.array([0.02, 0.04, 0.03])


def clamped() -> Anatomy:
    """The base held: every footprint is free."""
    return hold(MESH, BASE)


def compile_clamped_part() -> Anatomy:
    """Part of each footprint is held, part of it slides."""
    held = np.repeat(BASE[:, None], 3, axis=1)
    held[TOP & (MESH.nodes[:, 0] > 0.08)] = True
    slides = TOP & (MESH.nodes[:, 1] < 0.04) & ~held.any(axis=1)
    return hold(MESH, held, np.where(slides[:, None], [0.0, 0.6, 0.8], 0.0))


@pytest.mark.parametrize("body", [clamped, compile_clamped_part])
def test_tool_displacement_is_mean_of_its_footprint(body) -> None:
    found = solve(body(), [Held(), Slide(), ToolDisplacement()], Displaced(POINT, MOTION, RADIUS))
    weight = compute_footprint_weights(MESH.nodes, MESH.surface, POINT, RADIUS).toarray()
    mean = np.einsum("bv,bvi->bi", weight, found.displacement)
    np.testing.assert_allclose(mean, MOTION, atol=1e-9 * np.abs(MOTION).max())


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("body", [clamped, compile_clamped_part])
def test_push_with_reaction_reproduces_displacement(body, element: str) -> None:
    """Both kinds of tool are dual: the force of a displacement gives this displacement."""
    effects, accuracy = [Held(), Slide(), ToolDisplacement()], Accuracy(tolerance=1e-10, limit_strain=False)
    moved = solve(body(), effects, Displaced(POINT, MOTION, RADIUS), accuracy=accuracy, element=element)
    assert moved.reaction.shape == (3, 1, 6)
    force = moved.reaction[:, 0, :3]
    assert (np.einsum("bi,bi->b", force, MOTION) > 0.0).all()
    effects = [Held(), Slide(), ToolForce()]
    pushed = solve(body(), effects, Pushed(POINT, force, RADIUS), accuracy=accuracy, element=element)
    scale = np.abs(moved.displacement).max()
    np.testing.assert_allclose(pushed.displacement, moved.displacement, atol=1e-7 * scale)
    np.testing.assert_allclose(pushed.reaction, moved.reaction, atol=1e-9)


def test_reaction_includes_moment_about_tool_point() -> None:
    force = np.array([[0.1, 0.2, -0.3]])
    found = solve(clamped(), [Held(), ToolForce()], Pushed(POINT[:1], force, RADIUS[:1]))
    weight = compute_footprint_weights(MESH.nodes, MESH.surface, POINT[:1], RADIUS[:1]).toarray()[0]
    moment = (weight[:, None] * np.cross(MESH.nodes - POINT[0], force[0])).sum(axis=0)
    np.testing.assert_allclose(found.reaction[0, 0], [*force[0], *moment], atol=1e-15)


def test_displacement_of_held_footprint_is_rejected() -> None:
    fem = Fem(hold(MESH, BASE | TOP), [SOFT, Held(), ToolDisplacement()], TIGHT, "cpu", element="p1")
    with pytest.raises(InputError, match="fixed"):
        fem.deform(Loads((Displaced(POINT[:1], MOTION[:1], RADIUS[:1]),)))


def test_displacement_normal_to_sliding_plane_is_rejected() -> None:
    anatomy = hold(MESH, BASE, np.where(TOP[:, None], [0.0, 0.0, 1.0], 0.0))
    fem = Fem(anatomy, [SOFT, Held(), Slide(), ToolDisplacement()], TIGHT, "cpu", element="p1")
    with pytest.raises(InputError, match="fixed"):
        fem.deform(Loads((Displaced(POINT[:1], MOTION[:1], RADIUS[:1]),)))


@pytest.mark.parametrize(
    ("held", "sentence"),
    [
        (np.zeros(COUNT, bool), "6 of 6"),
        (np.arange(COUNT) == 5, "3 of 6"),
        (np.isin(np.arange(COUNT), np.flatnonzero(BASE & (MESH.nodes[:, 1] < 1e-9))), "1 of 6"),
    ],
)
def test_body_with_free_rigid_motion_is_rejected(held: np.ndarray, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        Fem(hold(MESH, held), [SOFT, Held(), NodalForce()], TIGHT, "cpu", element="p1")


def test_three_sliding_walls_prevent_rigid_motion() -> None:
    """Three sliding faces leave no rigid motion; two leave one."""
    faces = np.where(MESH.nodes < 1e-9, 1.0, 0.0)
    for used, free in (([0, 1, 2], 0), ([0, 2], 1), ([2], 3)):
        normal = np.zeros((COUNT, 3))
        for axis in used:
            normal[(faces[:, axis] > 0.0) & ~normal.any(axis=1), axis] = 1.0
        anatomy = hold(MESH, np.zeros(COUNT, bool), normal)
        if free:
            with pytest.raises(InputError, match=f"{free} of 6"):
                Fem(anatomy, [SOFT, Held(), Slide(), NodalForce()], TIGHT, "cpu", element="p1")
            continue
        force = np.zeros((1, COUNT, 3))
        force[0, TOP, 2] = -0.01
        found = solve(anatomy, [Held(), Slide(), NodalForce()], Nodal(force))
        assert found.displacement[0, TOP, 2].max() < -1e-4
        assert np.abs(np.einsum("vi,vi->v", found.displacement[0], normal)).max() < 1e-15


def test_six_held_components_prevent_rigid_motion() -> None:
    """Statically determinate: forces in balance deform it, and the six reactions vanish."""
    a, b, c = (int(np.argmin(np.linalg.norm(MESH.nodes - p, axis=1))) for p in ([0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]))
    held = np.zeros((COUNT, 3), bool)
    held[a] = True
    held[b, 1:] = True
    held[c, 2] = True
    force = np.zeros((1, COUNT, 3))
    force[0, TOP, 2], force[0, BASE, 2] = 0.3 / TOP.sum(), -0.3 / BASE.sum()
    anatomy = hold(MESH, held)
    fem = Fem(anatomy, [SOFT, Held(), NodalForce()], TIGHT, "cpu", element="p1")
    found = fem.deform(Loads((Nodal(force),)))
    assert found.outcome[0].good
    assert found.displacement[0, TOP, 2].mean() > 1e-4
