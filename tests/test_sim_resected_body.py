"""Resected tissue: the remainder agrees with a body meshed without it; loose pieces are removed and reported."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import base_held, box, hold, quadratic
from cuts import BODY, DOWN, EFFECTS, MESH, NEXT, SOFT, STEPS, TIGHT, TOP, lying, within

from sim.accuracy import Accuracy
from sim.anatomy import Anatomy
from sim.compile import compile_problem
from sim.deformation import build_start
from sim.discretisation.resected_body import compute_remaining_bodies, list_remaining_bodies
from sim.effects import Elasticity, Gravity, Held, Inertia, NodalForce, Resection, SkullContact, Slide, ToolContact
from sim.elements import ELEMENTS
from sim.errors import InputError
from sim.fem import Fem
from sim.geometry.tetmesh import TetMesh
from sim.loads import Loads, Nodal, Posture, Resected, Touching, build_posture, push
from sim.material import Material
from sim.resected_fem import ResectedFem, build_fem
from sim.runtime.device import find_device
from sim.tools import Ball


def compact(anatomy: Anatomy) -> tuple[Anatomy, np.ndarray]:
    """The same body meshed without its orphans, and which vertices are left."""
    mesh, used = anatomy.mesh, np.flatnonzero(~anatomy.orphaned)
    tets = np.searchsorted(used, mesh.tets)
    middles = None if mesh.middles is None else np.searchsorted(used, mesh.middles)
    fresh = TetMesh(mesh.nodes[used], tets, mesh.region, middles)
    return Anatomy(fresh, anatomy.fixed[used], anatomy.slide_normal[used], anatomy.craniotomy[used]), used


def solver(steps: Resection = STEPS, element: str | None = "p1", **values: object) -> ResectedFem:
    made = build_fem(BODY, (*EFFECTS, steps), TIGHT, "cpu", element=element, **values)  # type: ignore
    assert isinstance(made, ResectedFem)
    return made


@pytest.fixture(scope="module")
def operated() -> ResectedFem:
    return solver()


@pytest.mark.parametrize("element", ELEMENTS)
def test_resected_body_agrees_with_mesh_of_the_remainder(element: str) -> None:
    made = solver(element=element)
    loads = Loads((*lying([2, 1]).causes, *push([0.005, 0.05, 0.06], [0.0, 0.02, -0.1], 0.012).select([0, 0]).causes))
    answer = made.deform(loads)
    for row, done in enumerate((2, 1)):
        body, used = compact(made.get_remaining_body(done).anatomy)
        alone = Fem(body, EFFECTS, TIGHT, "cpu", element=element).deform(loads.drop(Resected).select(np.array([row])))
        assert alone.outcome[0].good and answer.outcome[row].good
        size = np.abs(alone.displacement).max()
        assert size > 1e-4
        np.testing.assert_allclose(answer.displacement[row, used], alone.displacement[0], atol=1e-9 * size)
        assert not np.delete(answer.displacement[row], used, axis=0).any()
        np.testing.assert_allclose(answer.reaction[row], alone.reaction[0], rtol=1e-9)


def test_resection_removes_own_mid_edge_nodes() -> None:
    curved = quadratic(box((2, 2, 2), 0.04, distortion=0.1), curved=0.05)
    body, effects = base_held(curved), EFFECTS[:3]
    made = build_fem(body, (*effects, Resection((within((1, 1, 1), (2, 2, 2), curved),))), TIGHT, "cpu")
    assert isinstance(made, ResectedFem)
    left, used = compact(made.get_remaining_body(1).anatomy)
    alone = Fem(left, effects, TIGHT, "cpu").deform(build_posture(DOWN, -1.0))
    answer = made.deform(build_posture(DOWN, -1.0))
    assert 0 < len(used) < len(curved.nodes)
    np.testing.assert_allclose(
        answer.displacement[0, used], alone.displacement[0], atol=1e-9 * np.abs(alone.displacement).max()
    )


def test_loads_without_resected_cause_apply_all_steps(operated: ResectedFem) -> None:
    silent = operated.deform(build_posture(DOWN, -1.0))
    said = operated.deform(lying([2]))
    np.testing.assert_array_equal(silent.displacement, said.displacement)


def test_zero_resection_steps_give_the_whole_body(operated: ResectedFem) -> None:
    plain = Fem(BODY, EFFECTS, TIGHT, "cpu", element="p1").deform(build_posture(DOWN, -1.0))
    np.testing.assert_array_equal(operated.deform(lying([0])).displacement, plain.displacement)


def test_load_cases_have_separate_resection_steps(operated: ResectedFem) -> None:
    done = [2, 0, 1, 0, 2]
    together = operated.deform(lying(done))
    for row, one in enumerate(done):
        alone = operated.deform(lying([one]))
        np.testing.assert_allclose(together.displacement[row], alone.displacement[0], atol=1e-12)
    assert together.time.shape == (5,) and len(together.outcome) == 5


def test_resection_without_weight_causes_no_displacement(operated: ResectedFem) -> None:
    at_rest = Loads((Posture(np.array([[0.0, 0.0, -1.0]]), np.array([1.0]), np.ones(1)), Resected(np.array([1]))))
    assert not operated.deform(at_rest).displacement.any()


def test_forces_on_wall_of_resection_cavity_move_tissue(operated: ResectedFem) -> None:
    """The wall of the cavity is part of the surface."""
    wall = np.setdiff1d(np.unique(operated.get_remaining_body(2).anatomy.mesh.surface), np.unique(MESH.surface))
    force = np.zeros((1, len(MESH.nodes), 3))
    force[0, wall, 2] = -0.01
    effects = (Elasticity(SOFT), Held(), NodalForce(), STEPS)
    answer = build_fem(BODY, effects, TIGHT, "cpu", element="p1").deform(Loads((Nodal(force),)))
    assert len(wall) and (answer.displacement[0, wall, 2] < 0.0).all()


class TestAcrossCuts:
    @pytest.mark.parametrize("element", ELEMENTS)
    def test_result_of_other_steps_is_a_valid_start(self, element: str) -> None:
        made = solver(element=element, live=True)
        cold = {done: made.deform(lying([done])) for done in range(3)}
        last = None
        for done in (0, 0, 1, 2, 0, 2):
            last = made.deform(lying([done]), last)
            assert last.outcome[0].good
            size = np.abs(cold[done].displacement).max()
            np.testing.assert_allclose(last.displacement, cold[done].displacement, atol=1e-7 * size)

    def test_resected_results_are_deterministic(self, operated: ResectedFem) -> None:
        start = operated.deform(lying([1]))
        first = operated.deform(lying([2]), start)
        operated.deform(lying([0]))
        again = operated.deform(lying([2]), start)
        np.testing.assert_array_equal(first.displacement, again.displacement)
        np.testing.assert_array_equal(start.displacement, operated.deform(lying([1])).displacement)

    def test_rows_start_from_their_own_resection_step(self, operated: ResectedFem) -> None:
        start = operated.deform(lying([0, 1, 2]))
        answer = operated.deform(lying([1, 1, 0]), start)
        for row, done in enumerate((1, 1, 0)):
            alone = operated.deform(lying([done]))
            np.testing.assert_allclose(answer.displacement[row], alone.displacement[0], atol=1e-10)

    def test_guess_is_a_valid_start_of_a_resected_body(self, operated: ResectedFem) -> None:
        """It also moves vertices without remaining tissue."""
        wild = build_start(1e-4 * np.random.default_rng(1).normal(size=(1, len(MESH.nodes), 3)))
        answer = operated.deform(lying([2]), wild)
        exact = operated.deform(lying([2])).displacement
        np.testing.assert_allclose(answer.displacement, exact, atol=1e-8 * np.abs(exact).max())

    @pytest.mark.parametrize("element", ELEMENTS)
    def test_velocities_continue_across_a_resection(self, element: str) -> None:
        """Includes mid-edge nodes: a hundredth of a step later the motion continues in its direction."""
        effects = (*EFFECTS[:3], Inertia(), STEPS)
        made = build_fem(BODY, effects, Accuracy(tolerance=1e-9), "cpu", element=element)
        first = made.deform(replace(lying([0]), time=np.array([0.01])))
        second = made.deform(replace(lying([1]), time=np.array([0.0101])), first)
        still = made.deform(replace(lying([1]), time=np.array([0.0101])), replace(first, memory={}))
        stays = ~made.get_remaining_body(1).anatomy.orphaned  # type: ignore
        one, other, dead = (answer.displacement[0, stays] for answer in (first, second, still))
        flown = 1e-4 * np.linalg.norm(first.memory["inertia"][0, : len(MESH.nodes)][stays], axis=1)
        moved = np.linalg.norm(other - one, axis=1)
        assert moved.max() > 5.0 * np.abs(dead - one).max()
        np.testing.assert_allclose(moved, flown, atol=0.1 * flown.max())
        assert second.memory["inertia"].shape == first.memory["inertia"].shape


class TestWhatComesLoose:
    SLICE = within((0, 0, 1), (3, 3, 2))

    def test_loose_piece_is_removed_and_reported(self) -> None:
        """A slice through the box separates its upper third."""
        _, left = compute_remaining_bodies(BODY, Resection((self.SLICE,)))
        above = within((0, 0, 2), (3, 3, 4))
        assert tuple(left.loose_tetrahedra.tolist()) == above
        assert f"{len(above)} tetrahedra that nothing held any more went too" in str(left)
        np.testing.assert_array_equal(left.anatomy.orphaned, MESH.nodes[:, 2] > 0.03)

    def test_removing_loose_piece_equals_resecting_it(self) -> None:
        made, both = solver(Resection((self.SLICE,))), solver(Resection((self.SLICE + within((0, 0, 2), (3, 3, 4)),)))
        answers = [each.deform(lying([1])).displacement for each in (made, both)]
        assert np.abs(answers[0]).max() > 1e-6
        np.testing.assert_array_equal(answers[0], answers[1])

    def test_loose_piece_may_be_resected_in_a_later_step(self) -> None:
        left = compute_remaining_bodies(BODY, Resection((self.SLICE, within((0, 0, 2), (3, 3, 4)))))
        assert len(left[1].loose_tetrahedra) and not len(left[2].loose_tetrahedra)
        np.testing.assert_array_equal(left[1].anatomy.mesh.tets, left[2].anatomy.mesh.tets)

    def test_piece_connected_by_an_edge_only_is_removed(self) -> None:
        """Two cubes of the top layer that share an edge only with the rest."""
        keep = set(within((0, 0, 1), (1, 1, 2)) + within((1, 1, 2), (2, 2, 4)))
        above = [number for number in within((0, 0, 1), (3, 3, 4)) if number not in keep]
        _, left = compute_remaining_bodies(BODY, Resection((tuple(above),)))
        assert set(left.loose_tetrahedra.tolist()) == set(within((1, 1, 2), (2, 2, 4)))

    def test_piece_held_by_three_sliding_planes_stays(self) -> None:
        """A box that only slides on three planes."""
        normal = np.zeros_like(MESH.nodes)
        for axis in range(3):
            normal[(MESH.nodes[:, axis] < 1e-9) & ~normal.any(axis=1), axis] = -1.0
        corner = hold(MESH, np.zeros(len(MESH.nodes), bool), normal)
        assert [len(one.loose_tetrahedra) for one in compute_remaining_bodies(corner, Resection((TOP,)))] == [0, 0]

    def test_piece_that_only_slides_on_the_skull_is_removed(self) -> None:
        """The skull prevents no tangential motion."""
        wall = np.where((MESH.nodes[:, :1] > 0.06 - 1e-9) & (MESH.nodes[:, 2:] > 1e-9), [1.0, 0.0, 0.0], 0.0)
        sliding = hold(MESH, MESH.nodes[:, 2] < 1e-9, wall)
        _, left = compute_remaining_bodies(sliding, Resection((self.SLICE,)))
        assert tuple(left.loose_tetrahedra.tolist()) == within((0, 0, 2), (3, 3, 4))


class TestHardCases:
    def test_resection_of_rim_and_held_vertices_is_solved(self) -> None:
        """A resection to the held floor through the opening's edge removes held, sliding and open vertices."""
        normal = np.where((MESH.nodes[:, :1] < 1e-9) & (MESH.nodes[:, 2:] > 1e-9), [-1.0, 0.0, 0.0], 0.0)
        opened = MESH.nodes[:, 2] > 0.06 - 1e-9
        body = replace(hold(MESH, MESH.nodes[:, 2] < 1e-9, normal), craniotomy=opened)
        cut = Resection((within((0, 0, 0), (1, 1, 4)),))
        effects = (Elasticity(SOFT), Held(), Slide(), Gravity(direction=(0.0, 0.0, -1.0)))
        made = build_fem(body, (*effects, cut), TIGHT, "cpu", element="p1")
        assert isinstance(made, ResectedFem)
        left = made.get_remaining_body(1).anatomy
        gone = left.orphaned
        assert (gone & BODY.fixed[:, 0]).any() and (gone & normal.any(axis=1)).any() and (gone & opened).any()
        assert left.fixed[gone].all() and not left.slide_normal[gone].any() and not left.craniotomy[gone].any()
        compacted, used = compact(left)
        alone = Fem(compacted, effects, TIGHT, "cpu", element="p1").deform(build_posture(DOWN, 0.03))
        answer = made.deform(build_posture(DOWN, 0.03))
        np.testing.assert_allclose(answer.displacement[0, used], alone.displacement[0], atol=1e-12)

    def test_law_of_completely_resected_tissue_is_ignored(self) -> None:
        region = np.zeros(len(MESH.tets), int)
        region[list(TOP)] = 2
        body = base_held(replace(MESH, region=region))
        effects = (Elasticity(SOFT, {2: Material("linear", 9000.0, 0.3)}), *EFFECTS[1:])
        answer = build_fem(body, (*effects, Resection((TOP,))), TIGHT, "cpu", element="p1").deform(lying([1]))
        np.testing.assert_allclose(answer.displacement, solver(Resection((TOP,))).deform(lying([1])).displacement)

    @pytest.mark.parametrize(
        ("steps", "sentence"),
        [
            ((), "no steps"),
            ((1, 2), "not numbers of tetrahedra: give those of each step"),
            (((1, 2), ()), "step 2 of Resection is empty"),
            (((1, 2), (5, 2)), "tetrahedron 2 in step 1 and again in step 2: name it once"),
            (((4, 4),), "tetrahedron 4 in step 1 and again in step 1"),
        ],
    )
    def test_invalid_resection_steps_are_rejected(self, steps: tuple[tuple[int, ...], ...], sentence: str) -> None:
        with pytest.raises(InputError, match=sentence):
            Resection(steps)

    @pytest.mark.parametrize(
        ("step", "sentence"),
        [
            ((162,), r"step 2 of Resection cannot be done: the mesh has no tetrahedron 162: choose from 0 to 161"),
            ((-1,), "no tetrahedron -1"),
            (tuple(set(range(162)) - set(TOP)), "step 2 of Resection cannot be done: all 162 tetrahedra are removed"),
            (within((0, 0, 0), (3, 3, 1)), "step 2 of Resection cannot be done: all 162 tetrahedra are removed"),
        ],
    )
    def test_resection_steps_that_do_not_fit_body_are_rejected(self, step: tuple[int, ...], sentence: str) -> None:
        with pytest.raises(InputError, match=sentence):
            compute_remaining_bodies(BODY, Resection((TOP, step)))

    def test_remainder_on_a_hinge_is_rejected(self) -> None:
        """One held edge: the piece can rotate about it."""
        floor = (MESH.nodes[:, 2] < 1e-9) & (MESH.nodes[:, 0] > 0.06 - 1e-9)
        edge = replace(BODY, fixed=np.repeat(((MESH.nodes[:, 2] > 0.06 - 1e-9) | floor)[:, None], 3, axis=1))
        made = build_fem(edge, (*EFFECTS, Resection((self.MIDDLE_LAYER,))), TIGHT, "cpu", element="p1")
        with pytest.raises(InputError, match="can move rigidly in 1 of 6 ways"):
            made.deform(lying([1]))

    MIDDLE_LAYER = within((0, 0, 1), (3, 3, 2))

    @pytest.mark.parametrize("done", [-1.0, 0.5])
    def test_negative_or_fractional_resection_step_is_rejected(self, done: float) -> None:
        with pytest.raises(InputError, match="integers >= 0"):
            Loads((Resected(np.array([done])),))

    def test_more_resection_steps_than_defined_are_rejected(self, operated: ResectedFem) -> None:
        with pytest.raises(InputError, match="done is 3, but Resection has 2 steps"):
            operated.deform(lying([1, 3]))

    def test_plain_solver_rejects_resection_and_names_build_fem(self) -> None:
        with pytest.raises(InputError, match=r"sim\.build_fem"):
            compile_problem((*EFFECTS, STEPS), BODY, find_device("cpu", "float64"))
        with pytest.raises(InputError, match="occurs 2 times"):
            build_fem(BODY, (*EFFECTS, STEPS, STEPS))
        with pytest.raises(InputError, match="Resected, which no effect uses: add the effect Resection"):
            Fem(BODY, EFFECTS, TIGHT, "cpu", element="p1").deform(lying([1]))

    def test_build_fem_without_resection_gives_plain_solver(self) -> None:
        assert isinstance(build_fem(BODY, EFFECTS, TIGHT, "cpu"), Fem)


def test_scaled_load_keeps_its_resection_step() -> None:
    half = lying([1]).scale(0.5)
    assert half.get(Resected).done.tolist() == [1.0] and half.get(Posture).share.tolist() == [0.5]  # type: ignore


def test_piece_touching_only_contact_skull_is_removed() -> None:
    """Under `SkullContact` a piece on the wall comes loose; the remainder still meets its bone."""
    wall = np.where((MESH.nodes[:, :1] > 0.06 - 1e-9) & (MESH.nodes[:, 2:] > 1e-9), [1.0, 0.0, 0.0], 0.0)
    body, cut = hold(MESH, MESH.nodes[:, 2] < 1e-9, wall), Resection((within((2, 2, 2), (3, 3, 4)),))
    effects = (Elasticity(SOFT), Held(), SkullContact(), Gravity(direction=(0.0, 0.0, -1.0)))
    left = list_remaining_bodies(body, (*effects, cut))[1].anatomy
    assert left.slide_normal.any() and left.orphaned.any()
    aside = build_posture(np.array([1.0, 0.0, -0.2]), -1.0)
    answer = build_fem(body, (*effects, cut), TIGHT, "cpu", element="p1").deform(aside)
    compacted, used = compact(left)
    alone = Fem(compacted, effects, TIGHT, "cpu", element="p1").deform(aside)
    np.testing.assert_allclose(answer.displacement[0, used], alone.displacement[0], atol=1e-9)
    assert 1e-6 < answer.displacement[0, left.slide_normal.any(axis=1), 0].max() < 1.1e-4  # the gap of the bone
    slice_ = Resection((TestWhatComesLoose.SLICE,))
    assert len(list_remaining_bodies(body, (*effects, slice_))[1].loose_tetrahedra) == len(within((0, 0, 2), (3, 3, 4)))


def test_vertices_are_free_without_effects_that_hold_them() -> None:
    """The anatomy's held and sliding vertices count only with the effects for them."""
    normal = np.zeros_like(MESH.nodes)
    for axis in range(3):
        normal[(MESH.nodes[:, axis] < 1e-9) & ~normal.any(axis=1), axis] = -1.0
    body = hold(MESH, MESH.nodes[:, 2] < 1e-9, normal)
    sliding = (Elasticity(SOFT), Slide(), Gravity(direction=(0.0, 0.0, -1.0)))
    corner = Resection((within((2, 2, 2), (3, 3, 4)),))
    answer = build_fem(body, (*sliding, corner), TIGHT, "cpu", element="p1").deform(lying([1]))
    bare, used = compact(
        compute_remaining_bodies(hold(MESH, np.zeros(len(MESH.nodes), bool), normal), corner)[1].anatomy
    )
    assert len(used) == len(MESH.nodes) - 1
    alone = Fem(bare, sliding, TIGHT, "cpu", element="p1").deform(build_posture(DOWN, -1.0))
    np.testing.assert_allclose(answer.displacement[0, used], alone.displacement[0], atol=1e-12)
    with pytest.raises(InputError, match="can move rigidly in 6 of 6 ways"):
        build_fem(body, (Elasticity(SOFT), Resection((NEXT,))), TIGHT, "cpu").deform(lying([0]).drop(Posture))


def test_empty_batch_with_resection_gives_empty_result() -> None:
    fem = build_fem(BODY, (*EFFECTS, Inertia(), STEPS), TIGHT, "cpu")
    assert fem.deform(lying([])).displacement.shape == (0, len(MESH.nodes), 3)


def test_tool_pose_is_kept_across_a_resection() -> None:
    fem = build_fem(BODY, (*EFFECTS[:2], ToolContact((Ball(0.01),)), STEPS), TIGHT, "cpu")
    pose = np.eye(4)
    pose[:3, 3] = [0.01, 0.03, 0.057]
    standing = Touching(pose[None, None])
    before, after = (fem.deform(Loads((standing, Resected(np.array([done]))))) for done in (0, 1))
    cut = fem.deform(Loads((standing, Resected(np.array([1])))), before)
    assert cut.outcome[0].good and cut.iterations[0] < after.iterations[0]
    assert np.abs(cut.displacement - after.displacement).max() < 1e-9
