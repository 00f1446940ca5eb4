"""Treatment of load cases whose tools overlap bone: these are not solved, and the mesh keeps its initial values."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..deformation import Outcome
from ..discretisation.term import Cases
from .solver_result import SolverResult
from .strategy import Strategy
from .time_steps import NoMotionStep


def solve_without_bone(strategy: Strategy | NoMotionStep, cases: Cases, guesses: Sequence[np.ndarray]) -> SolverResult:
    """Return the result of `Strategy.solve` for cases whose tools do not overlap bone; others keep their last guess.

    Bone does not deform: a solution would depend only on the barrier stiffness, and take long.
    """
    problem, device, count = strategy.problem, strategy.problem.device, len(cases.loads)
    if isinstance(strategy, NoMotionStep) or not problem.barriers:
        return strategy.solve(cases, guesses)
    problem.begin(cases)
    on_bone = problem.find_overlaps(device.allocate(problem.rows, count))[1]
    if not on_bone.any():
        return strategy.solve(cases, guesses)
    u = device.upload(guesses[-1]) if guesses else device.allocate(problem.rows, count)
    none, outcome = np.zeros(count, int), np.full(count, Outcome.ON_BONE, object)
    result = SolverResult(u, outcome, none, np.full(count, np.inf), np.zeros(count), strategy.inversion.count(u), 0)
    restarted, clear = np.zeros(count, bool), np.flatnonzero(~on_bone)
    if len(clear):
        found = strategy.solve(cases.select(clear), [guess[:, clear] for guess in guesses])
        result.replace_cases(clear, found, device)
        restarted[clear] = found.restarted
    return replace(result, path_fraction=result.reached, restarted=restarted)
