"""Contact descent with separate steps for contact and tissue: each part against another method."""

from functools import cache

import numpy as np
import warp as wp
from boxes import base_held, box

from sim.accuracy import TRAIN, Accuracy
from sim.effects import Elasticity, Held, ToolContact
from sim.fem import Fem
from sim.linalg.pcg import Preconditioner
from sim.loads import Loads, Touching
from sim.local_solvers.contact_descent import ContactDescent
from sim.material import Material
from sim.strategy.plan import SolverStep
from sim.tools import Ball

SIDE, HEIGHT, RADIUS = 0.06, 0.03, 6e-3
BODY = base_held(box((6, 6, 3), SIDE))


def at(x: float, y: float, z: float) -> np.ndarray:
    """T_world_tool (4, 4) of an upright tool at a place [m]."""
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def touching(*poses: np.ndarray) -> Loads:
    """One tool in so many load cases."""
    return Loads((Touching(np.stack(poses)[:, None]),))


DOWN = at(0.031, 0.028, HEIGHT - 3e-3)
ASIDE = at(0.036, 0.03, HEIGHT - 4e-3)


@cache
def solver(accuracy: Accuracy) -> Fem:
    effects = [Elasticity(Material("neo-hookean", 3000.0, 0.45)), Held(), ToolContact((Ball(RADIUS),))]
    return Fem(BODY, effects, accuracy, "cpu", element="p1")


@cache
def parts() -> tuple[Fem, ContactDescent]:
    """A solver, and its descent."""
    fem = solver(Accuracy(1e-6))
    found = fem.strategy.contact
    assert found is not None
    return fem, found


class Rough:
    """What a preconditioner does, each number off by up to a share; it makes all columns by itself."""

    def __init__(self, whole: Preconditioner, share: float):
        self._whole, self._share, self._random = whole, share, np.random.default_rng(5)

    def apply(self, r: wp.array, live: np.ndarray, out: wp.array) -> None:
        self._whole.apply(r, live, out)
        out.assign(out.numpy() * (1.0 + self._share * self._random.uniform(-1.0, 1.0, out.shape)))


def test_contact_case_alone_agrees_with_case_in_batch() -> None:
    """Columns with other paths and other numbers of steps are independent."""
    fem, shallow = solver(Accuracy(1e-8)), at(0.02, 0.02, HEIGHT + RADIUS - 2e-4)
    poses = (ASIDE, shallow, DOWN, at(0.04, 0.012, HEIGHT - 5e-3))
    batch = fem.deform(touching(*poses))
    assert all(outcome.good for outcome in batch.outcome)
    assert len(set(batch.iterations.tolist())) > 1
    for row, pose in enumerate(poses):
        alone = fem.deform(touching(pose))
        np.testing.assert_allclose(alone.displacement[0], batch.displacement[row], atol=1e-9)
        np.testing.assert_allclose(alone.reaction[0], batch.reaction[row], rtol=1e-6, atol=1e-9)


def test_contact_descent_agrees_with_newton() -> None:
    """Includes deep poses, where the model of the tissue is inaccurate."""
    effects = [Elasticity(Material("neo-hookean", 3000.0, 0.45)), Held(), ToolContact((Ball(RADIUS),))]
    poses = touching(DOWN, at(0.031, 0.028, HEIGHT - 6e-3), at(0.012, 0.045, HEIGHT - 5e-3))
    newton = Fem(BODY, effects, Accuracy(1e-7), "cpu", element="p1", avoid=(SolverStep.CONTACT,)).deform(poses)
    found = solver(Accuracy(1e-7)).deform(poses)
    assert all(outcome.good for outcome in (*newton.outcome, *found.outcome))
    np.testing.assert_allclose(found.displacement, newton.displacement, atol=1e-8)


def test_contact_batch_with_one_slow_case_converges() -> None:
    """Curvature pairs of the last, slow case are not stored for the batch."""
    fem, far = solver(Accuracy(1e-6)), touching(DOWN, at(0.045, 0.04, HEIGHT - 3e-3))
    second = fem.deform(far, fem.deform(touching(DOWN, DOWN)))
    assert {len(value) for value in second.memory.values()} == {2}
    third = fem.deform(far, second)
    assert all(outcome.good for outcome in third.outcome)
    np.testing.assert_allclose(third.displacement, second.displacement, atol=1e-5)


def test_contact_without_poses_gives_empty_result() -> None:
    fem = solver(Accuracy(1e-6))
    none = fem.deform(touching(DOWN).select(np.zeros(0, int)))
    assert none.displacement.shape == (0, len(BODY.mesh.nodes), 3)


def test_contact_result_is_independent_of_earlier_solves() -> None:
    fem = solver(TRAIN)
    begun = fem.deform(touching(DOWN))
    first = fem.deform(touching(ASIDE), begun)
    fem.deform(touching(at(0.012, 0.045, HEIGHT - 2e-3)))
    again = fem.deform(touching(ASIDE), begun)
    np.testing.assert_array_equal(first.displacement, again.displacement)
    np.testing.assert_array_equal(first.reaction, again.reaction)
    for name, array in first.memory.items():
        np.testing.assert_array_equal(array, again.memory[name])
