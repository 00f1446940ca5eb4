"""Poses along a tool's shaft, each solved from the pose before."""

import numpy as np
from boxes import base_held, box

from sim.accuracy import Accuracy
from sim.effects import Elasticity, Held, ToolContact
from sim.fem import Fem
from sim.loads import Loads, Touching
from sim.material import BRAIN
from sim.tools import Ball
from surrogate.data.solver_pool import LazyFem, open_solvers
from surrogate.data.strokes import STROKE_LENGTH, find_continuations, solve_strokes

BODY = base_held(box((6, 6, 3), 0.06))
EFFECTS = Elasticity(BRAIN), Held(), ToolContact((Ball(6e-3),))


def build_loads(depths: tuple[float, ...], x: float = 0.031) -> Loads:
    pose = np.tile(np.eye(4), (len(depths), 1, 1, 1))
    pose[:, 0, :3, 3] = [(x, 0.028, 0.03 - depth) for depth in depths]
    return Loads((Touching(pose),))


def test_poses_deeper_along_the_shaft_continue_a_stroke() -> None:
    pose = build_loads((1e-3, 2e-3, 1.5e-3, 3e-3, 4e-3, 5e-3)).causes[0].pose
    pose[4:, 0, 0, 3] += 1e-3
    pose[5, 0, :3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    assert find_continuations(pose).tolist() == [False, True, False, True, False, False]
    assert find_continuations(pose[:1]).tolist() == [False]


def test_strokes_agree_with_single_poses_in_fewer_steps() -> None:
    fem = Fem(BODY, EFFECTS, Accuracy(1e-6), "cpu", element="smoothed")
    loads = build_loads((1e-3, 3e-3, 5e-3, 2e-3))
    found, expected = solve_strokes(fem, loads), fem.deform(loads)
    assert all(outcome.good for outcome in found.outcome)
    scale = np.abs(expected.displacement).max()
    np.testing.assert_allclose(found.displacement, expected.displacement, atol=1e-4 * scale)
    np.testing.assert_allclose(found.reaction, expected.reaction, atol=1e-4 * np.abs(expected.reaction).max())
    assert found.iterations[2] < expected.iterations[2] and not found.warm
    assert np.array_equal(found.displacement[[0, 3]], expected.displacement[[0, 3]])


def test_dataset_of_poses_is_solved_in_strokes() -> None:
    with open_solvers(LazyFem(BODY, EFFECTS, Accuracy(1e-4), "p1", None, 20), ["cpu"], print) as solver:
        assert solver.batch_size == STROKE_LENGTH
    with open_solvers(LazyFem(BODY, EFFECTS[:2], Accuracy(1e-4), "p1", 3, 20), ["cpu"], print) as solver:
        assert solver.batch_size == 3
