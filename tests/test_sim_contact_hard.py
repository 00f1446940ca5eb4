"""Hard contact: tools that jump, rotate, squeeze and stab. Each result is finite and outside, with a true outcome."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from boxes import base_held, box, hold
from scipy.spatial.transform import Rotation

from sim.accuracy import DRAFT, LIVE, TRAIN, Accuracy
from sim.anatomy import Anatomy
from sim.deformation import Deformation, Outcome
from sim.effects import Effect, Elasticity, Held, Retraction, ToolContact, ToolForce
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads, Pushed, Retracted, Touching
from sim.material import Material, Tissue
from sim.tools import Ball, Spatula, Tool, compute_distances

SIDE, HEIGHT = 0.06, 0.03
BLOCK = base_held(box((6, 6, 3), SIDE))
SOFT = Material("neo-hookean", 3000.0, 0.45)
BALL = Ball(6e-3)
CONVERGED = frozenset({Outcome.CONVERGED, Outcome.CONVERGED_ANEW, Outcome.CONVERGED_IN_STEPS})
# Of the gap, how far inside a tool tissue is found that bears more than the barrier does.
YIELDS = 0.5


def at(*place: float, turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """T_world_tool (4, 4) at a place [m], turned about x, y and z [degrees]."""
    T = np.eye(4)
    T[:3, 3] = place
    T[:3, :3] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
    return T


def touching(*poses: np.ndarray) -> Loads:
    return Loads((Touching(np.stack(poses)[None]),))


DOWN = at(0.03, 0.03, HEIGHT - 3e-3)


@dataclass(frozen=True, eq=False)
class Hard:
    """Tools, and their poses frame after frame; how the last may end."""

    frames: tuple[tuple[np.ndarray, ...], ...]
    tools: tuple[Tool, ...] = (BALL,)
    tissue: Tissue = SOFT
    accuracy: Accuracy = field(default=Accuracy(1e-4))
    gap: float = 1e-4
    ends: frozenset[Outcome] = CONVERGED
    element: str = "p1"


HARD = {
    "jumps to another place of the surface": Hard(((DOWN,), (at(0.045, 0.02, HEIGHT - 3e-3),))),
    "jumps through the body and its edge to its side": Hard(((DOWN,), (at(-0.004, 0.03, 0.018),))),
    "jumps to the side and tilts": Hard(((DOWN,), (at(0.058, 0.03, 0.015, turn=(0.0, 90.0, 0.0)),))),
    "jumps through the body into the air under it": Hard(((DOWN,), (at(0.03, 0.03, -0.02),))),
    "lets go and comes again": Hard(
        ((at(0.03, 0.03, HEIGHT - 6e-3),), (at(0.03, 0.03, HEIGHT + 1e-3),), (at(0.03, 0.03, HEIGHT - 1e-3),))
    ),
    "two squeeze the body": Hard(
        ((at(8e-3, 0.03, 0.02, turn=(0.0, -90.0, 0.0)), at(0.052, 0.03, 0.02, turn=(0.0, 90.0, 0.0))),), (BALL, BALL)
    ),
    "half off the edge": Hard(((at(0.0, 0.03, HEIGHT - 4e-3),),)),
    "half off the corner": Hard(((at(0.0, 0.0, HEIGHT - 4e-3),),)),
    "deeper than the body is thick": Hard(((at(0.03, 0.03, HEIGHT - 0.035),),), ends=frozenset({Outcome.ON_BONE})),
    "swallowed whole": Hard(((at(0.03, 0.03, HEIGHT - 6e-3),),), (Ball(2e-3),)),
    "turned by half a turn about its shaft": Hard(
        ((at(0.03, 0.03, HEIGHT - 2e-3),), (at(0.03, 0.03, HEIGHT - 2e-3, turn=(0.0, 0.0, 180.0)),)),
        (Spatula(0.012, 0.012, 3e-3),),
    ),
    "thin blade": Hard(((at(0.03, 0.03, HEIGHT - 1e-3),),), (Spatula(0.012, 0.02, 2.5e-4),)),
    "tip far smaller than an element": Hard(((at(0.033, 0.031, HEIGHT - 4e-4),),), (Ball(5e-4),)),
    "far inside at once": Hard(
        ((at(0.03, 0.03, 0.01),),), accuracy=Accuracy(1e-4, limit_strain=True), ends=frozenset({Outcome.OVERSTRAINED})
    ),
    "a touch of no depth": Hard(((at(0.03, 0.03, HEIGHT),), (at(0.03, 0.03, HEIGHT),))),
    "gap wider than the body": Hard(
        ((DOWN,),), accuracy=Accuracy(1e-4, outer=3), gap=0.2, ends=CONVERGED | {Outcome.BUDGET, Outcome.STALLED}
    ),
    "gap of a micrometre": Hard(((DOWN,),), gap=1e-6),
    "linear tissue": Hard(((DOWN,), (at(0.035, 0.03, HEIGHT - 4e-3),)), tissue=Material("linear", 3000.0, 0.45)),
    "stable tissue": Hard(
        ((DOWN,), (at(0.035, 0.03, HEIGHT - 4e-3),)), tissue=Material("stable-neo-hookean", 3000.0, 0.45)
    ),
    "hardly compressible": Hard(
        ((DOWN,), (at(0.035, 0.03, HEIGHT - 4e-3),)), tissue=Material("neo-hookean", 3000.0, 0.49), element="smoothed"
    ),
    "single precision": Hard(((DOWN,), (at(0.035, 0.03, HEIGHT - 4e-3),)), accuracy=LIVE),
    "a draft": Hard(((DOWN,), (DOWN,)), accuracy=DRAFT, ends=CONVERGED | {Outcome.BUDGET}),
}


def solver(hard: Hard, *more: Effect) -> Fem:
    effects = [Elasticity(hard.tissue), Held(), ToolContact(hard.tools, hard.gap), *more]
    return Fem(BLOCK, effects, hard.accuracy, "cpu", element=hard.element)


def lattice(anatomy: Anatomy, found: Deformation, row: int = 0) -> np.ndarray:
    """28 points (n, 3) [m] of every deformed surface triangle, of linear elements."""
    share = np.array([(i, j, 6 - i - j) for i in range(7) for j in range(7 - i)]) / 6.0
    moved = anatomy.mesh.nodes + found.displacement[row]
    return np.einsum("qc,scx->sqx", share, moved[anatomy.mesh.surface]).reshape(-1, 3)


@pytest.mark.parametrize("name", HARD)
def test_hard_contact_ends_with_expected_outcome(name: str) -> None:
    """A converged surface is outside of every tool up to the barrier's tolerance; else the outcome reports it."""
    hard, start = HARD[name], None
    fem = solver(hard)
    for poses in hard.frames:
        start = fem.deform(touching(*poses), start)
        assert np.isfinite(start.reaction).all()
        assert start.inverted[0] == 0
        points = lattice(BLOCK, start)
        # Where the tools are that the answer is of, asked for or reached.
        for tool, pose in zip(hard.tools, start.memory["tool contact"][0], strict=True):
            assert compute_distances(tool, pose, points).min() > -YIELDS * hard.gap
        if start.outcome[0].good:
            np.testing.assert_array_equal(start.memory["tool contact"][0], np.stack(poses))
    assert start is not None
    assert start.outcome[0] in hard.ends


def test_contact_cases_of_a_batch_are_independent() -> None:
    """Some approach, some retreat, some stay away: each agrees with its own solution."""
    ways = (
        (at(0.03, 0.03, HEIGHT + 0.01), at(0.03, 0.03, HEIGHT - 3e-3)),
        (at(0.03, 0.03, HEIGHT - 2e-3), at(0.03, 0.03, HEIGHT + 2e-3)),
        (at(0.02, 0.03, HEIGHT - 5e-3), at(0.025, 0.03, HEIGHT - 5e-3)),
        (at(0.03, 0.03, HEIGHT + 2e-3), at(0.03, 0.03, HEIGHT + 3e-3)),
    )
    fem = solver(Hard((), accuracy=Accuracy(1e-8)))
    first, second = (Loads((Touching(np.stack([way[frame][None] for way in ways])),)) for frame in (0, 1))
    together = fem.deform(second, fem.deform(first))
    for row, way in enumerate(ways):
        alone = fem.deform(touching(way[1]), fem.deform(touching(way[0])))
        np.testing.assert_allclose(together.displacement[row], alone.displacement[0], atol=1e-7)
        np.testing.assert_allclose(together.reaction[row], alone.reaction[0], atol=1e-5)
    assert not together.displacement[[1, 3]].any()
    assert together.displacement[[0, 2]].any(axis=(1, 2)).all()


def test_incomplete_contact_reports_its_tool_pose() -> None:
    """The result is in equilibrium at this pose, and the next frame continues from it."""
    fem = solver(Hard((), accuracy=Accuracy(1e-6, outer=6, steps=0)))
    short = fem.deform(touching(at(0.03, 0.03, HEIGHT - 9e-3)))
    assert short.outcome == (Outcome.BUDGET,)
    assert 0.0 < short.reached[0] < 1.0
    stood = short.memory["tool contact"][0]
    assert stood[0, 2, 3] > HEIGHT - 9e-3
    there = solver(Hard((), accuracy=Accuracy(1e-6))).deform(touching(*stood))
    np.testing.assert_allclose(short.displacement, there.displacement, atol=1e-5)
    np.testing.assert_allclose(short.reaction, there.reaction, atol=1e-3)
    following = solver(Hard((), accuracy=Accuracy(1e-6))).deform(touching(at(0.03, 0.03, HEIGHT - 6e-3)), short)
    assert following.outcome[0].good


def test_forces_of_push_and_contact_add_up() -> None:
    """A push far from the tool adds its own force: the base bears the sum."""
    fem = solver(Hard(()), ToolForce())
    pushed = Pushed(np.array([[0.045, 0.03, HEIGHT]]), np.array([[0.0, 0.0, -0.1]]), np.array([6e-3]))
    pose = at(0.018, 0.03, HEIGHT - 3e-3)
    both = fem.deform(Loads((pushed, Touching(pose[None, None]))))
    only = fem.deform(touching(pose))
    assert both.outcome[0].good
    assert both.reaction.shape == (1, 2, 6)
    np.testing.assert_array_equal(both.reaction[0, 0, :3], [0.0, 0.0, -0.1])
    node = np.linalg.norm(BLOCK.mesh.nodes - [0.05, 0.03, HEIGHT], axis=1).argmin()
    assert both.displacement[0, node, 2] < only.displacement[0, node, 2] - 1e-3
    # The push sinks the surface under the ball, too, which then has less to press away.
    assert only.reaction[0, 0, 2] < both.reaction[0, 1, 2] < 0.0


def test_tool_without_touching_load_has_no_effect() -> None:
    fem = solver(Hard(()))
    assert not fem.deform(Loads((), np.zeros(2))).displacement.any()


def test_lifted_retractor_leaves_no_displacement() -> None:
    fem = Fem(
        BLOCK, [Elasticity(SOFT), Held(), Retraction(Spatula(0.012, 0.02, 1.5e-3))], Accuracy(1e-6), "cpu", element="p1"
    )
    laid = at(0.03, 0.03, HEIGHT + 1e-3)[None]
    drawn = fem.deform(Loads((Retracted(laid, np.array([[0.0, 0.0, -3e-3]])),)))
    assert drawn.reaction[0, 0, 2] < 0.0
    lifted = fem.deform(Loads((Retracted(laid, np.array([[0.0, 0.0, 2e-3]])),)), drawn)
    assert not lifted.displacement.any()


def skewed() -> np.ndarray:
    T = at(0.03, 0.03, HEIGHT)
    T[0, 1] = 0.3
    return T


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: touching(skewed()), "no rigid motion: give rotations of determinant 1"),
        (lambda: touching(np.diag([1.0, 1.0, -1.0, 1.0])), "no rigid motion"),
        (lambda: touching(np.full((4, 4), np.nan)), "not finite"),
        (lambda: Loads((Touching(np.eye(4)[None]),)), r"pose has shape \(1, 4, 4\): give \(B, tools, 4, 4\)"),
        (lambda: Loads((Retracted(np.eye(4)[None, None], np.zeros((1, 3))),)), r"give \(B, 4, 4\)"),
        (lambda: solver(Hard(())).deform(touching(DOWN, DOWN)), "poses of 2 tools, but ToolContact has 1"),
        (lambda: solver(Hard((), (BALL, BALL))).deform(touching(DOWN)), "poses of 1 tools, but ToolContact has 2"),
        (
            lambda: Fem(BLOCK, [Elasticity(SOFT), Held()], TRAIN, "cpu", element="p1").deform(touching(DOWN)),
            "loads hold Touching, which no effect uses: add the effect ToolContact",
        ),
        (
            lambda: Fem(
                hold(BLOCK.mesh, np.ones(len(BLOCK.mesh.nodes), bool)),
                [Elasticity(SOFT), Held(), ToolContact((BALL,))],
                TRAIN,
                "cpu",
                element="p1",
            ),
            "finds no surface to touch: all of it is fixed or under the skull",
        ),
        (lambda: ToolContact(()), "ToolContact has no tool"),
        (lambda: ToolContact((7e-3,)), r"ToolContact has 0\.007 for a tool: choose from Ball, Capsule, Spatula"),  # type: ignore
        (lambda: ToolContact(7e-3), r"ToolContact has 0\.007 for a tool"),  # type: ignore
        (lambda: Retraction(BALL), r"Retraction has Ball\(radius=.*\) for a blade: give a Spatula"),  # type: ignore
        (
            lambda: solver(Hard((), (BALL, BALL))).deform(
                touching(DOWN, DOWN), solver(Hard(())).deform(touching(DOWN))
            ),
            r"memory of tool contact has shape \(1, 1, 4, 4\), not \(1, 2, 4, 4\): start from .* tools",
        ),
        (lambda: ToolContact((BALL,), 0.0), r"ToolContact\.gap is 0\.0 m"),
        (lambda: Retraction(Spatula(0.01, 0.01, 1e-3), np.inf), r"Retraction\.gap is inf"),
        (lambda: Ball(-1.0), r"Ball\.radius is -1\.0 m"),
        (lambda: Spatula(0.01, 1e-3, 1e-3), "no room for round edges"),
    ],
)
def test_invalid_contact_arguments_are_rejected(build: Callable[[], object], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        build()
