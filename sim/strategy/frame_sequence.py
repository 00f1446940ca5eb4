"""Sequence of pushes; each push starts from the solution of the last push, which is still on the device.

A start that must be uploaded from the host gives the same solution. For a load without a good solution, the result is
None, and the caller must use another solver.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from threading import RLock
from typing import Any
from weakref import ref

import numpy as np

from ..deformation import Cost, Deformation, Outcome
from ..diagnostics.deformed_tissue import Diagnostics
from ..discretisation.footprint import ContactSurface
from ..discretisation.inverted_elements import InversionCounter
from ..discretisation.problem import Problem
from ..discretisation.space import Discretisation
from ..discretisation.term import Cases
from ..loads import Loads
from ..local_solvers.strained_descent import build_strained_part
from ..local_solvers.strained_frame import UpdatedModel, restore_updated_model
from ..minimisers.lbfgs import HISTORY_KEYS, restore_history, to_rows_first
from ..minimisers.lbfgs_kernels import DONE
from ..minimisers.lbfgs_state import LbfgsState
from .captured_frame import HEADER_SIZE, INVERTED, RESIDUAL, STATUS, STEPS, SUMS, CapturedFrame
from .extrapolation import BEFORE_KEY, PUSHES_KEY, as_pushes, compute_directions, compute_factors, has_warm_state
from .strategy import Strategy

# Cyclic permutations, left and right, for a cross product in a fifth of the time of NumPy's.
YZX, ZXY = np.array([1, 2, 0]), np.array([2, 0, 1])


class DeviceWarmStart(Mapping[str, Any]):
    """Warm-start data of a solution; its L-BFGS history stays on the device until it is read or overwritten.

    `bent` is the model of strained tissue for the next frame. `lock` is the lock of the `FrameSequence`, since another
    thread may read the data while the next frame begins.
    """

    def __init__(
        self, data: Mapping[str, np.ndarray], state: LbfgsState, lock: RLock, model: UpdatedModel | None = None
    ):
        self._own, self._lock, self.bent = dict(data), lock, model
        self.state: LbfgsState | None = state

    def copy_to_host(self) -> None:
        """Copy data that is still on the device to the host."""
        with self._lock:
            if self.state is not None:
                self._own |= {name: to_rows_first(self.state.columns[name]) for name in HISTORY_KEYS}
                self._own |= {} if self.bent is None else self.bent.warm_start
                self.state = None

    def __getitem__(self, key: str) -> Any:
        if key not in self._own:
            self.copy_to_host()
        return self._own[key]

    def __iter__(self) -> Iterator[str]:
        self.copy_to_host()
        return iter(self._own)

    def __len__(self) -> int:
        self.copy_to_host()
        return len(self._own)


class FrameSequence:
    """Solver of single pushes with a start, for discretisations whose nodes are the mesh vertices.

    Parameters
    ----------
    problem, inversion
        Problem of the frames, and counter of its inverted elements.
    frame
        Solver on the device.
    diagnostics
        Diagnostics that check equilibria for excessive strain.
    lock
        Lock that the caller of `solve_frame` holds.
    source
        Name of the solver in the results.
    """

    def __init__(
        self,
        problem: Problem,
        inversion: InversionCounter,
        frame: CapturedFrame,
        diagnostics: Diagnostics,
        lock: RLock,
        source: str,
    ):
        self._diagnostics = diagnostics
        self._problem, self._inversion, self._frame, self._lock = problem, inversion, frame, lock
        self._source = source
        self._nodes = np.arange(problem.rows // 3)
        self._last: Callable[[], Deformation | None] = _return_none
        # Warm-start data whose history is in the frame's present state, and in the state that it started from.
        self._here: Callable[[], DeviceWarmStart | None] = _return_none
        self._there: Callable[[], DeviceWarmStart | None] = _return_none

    def solve_frame(self, loads: Loads, start: Deformation, guess: Callable[[], np.ndarray]) -> Deformation | None:
        """Return the deformation under a push, from a `start`, or None.

        The function `guess` checks the start and returns its displacements (3N, 1) [m].

        The result is None if this solver does not apply or fails: the load is not one push with a nonzero force, the
        start violates the constraints or has inverted elements, or the descent does not converge.
        """
        clock = time.perf_counter()
        now = as_pushes(loads)
        if now is None or len(now) != 1 or not now[0, 3:6].any():
            return None
        if start is self._last():
            last = start.displacement.reshape(-1, 1)
        else:
            last = guess()
            if not self._load_start(loads, start, last):
                return None
        self._release_state()
        way = compute_directions(now, last, start.warm)
        share = (
            compute_factors(now, way[PUSHES_KEY][:, 1], start.warm[PUSHES_KEY][:, 1])[0]
            if has_warm_state(start.warm, last)
            else 0.0
        )
        point, force, radius = now[0, :3], now[0, 3:6], now[0, 6]
        self._last = self._here = _return_none
        found = self._frame.solve_push(point, radius, force, share)
        if found[STATUS] != DONE or self._inversion.find_unreliable(found[INVERTED]):
            return None
        self._frame.update_model(found[STEPS])
        warm = DeviceWarmStart(way, self._frame.state, self._lock, self._frame.bent)
        arm = found[SUMS + 1 : SUMS + 4] / found[SUMS] - point
        displacement = found[HEADER_SIZE:].reshape(1, -1, 3).copy()
        displacement.setflags(write=False)  # a later start uses the copy on the device
        inverted, fields = found[INVERTED : INVERTED + 1].astype(int), self._diagnostics.compute_strains(self._frame.u)
        outcome = self._diagnostics.mark_outcomes(np.array([Outcome.CONVERGED]), inverted, fields["strained"])
        result = Deformation(
            displacement=displacement,
            nodes=self._nodes,
            outcome=tuple(outcome),
            iterations=found[STEPS : STEPS + 1].astype(int),
            residual=found[RESIDUAL : RESIDUAL + 1].copy(),
            time=loads.times,
            reaction=np.concatenate([force, arm[YZX] * force[ZXY] - arm[ZXY] * force[YZX]]).reshape(1, 1, 6),
            warm=warm,
            cost=Cost({"equilibrium": time.perf_counter() - clock}),
            reached=np.ones(1),
            inverted=inverted,
            stretch=fields["stretch"],
            strained=fields["strained"],
            source=self._source,
        )
        self._last, self._here = ref(result), ref(warm)
        return result

    def _load_start(self, loads: Loads, start: Deformation, last_u: np.ndarray) -> bool:
        """Load a start to the device; return False if the start is not usable."""
        cases = Cases(loads, start.time, start.memory, warm=start.warm)
        self._problem.begin(cases)
        u = self._problem.device.upload(last_u)
        if self._problem.compute_gap(u)[1].any() or self._inversion.find_unreliable(self._inversion.count(u)).any():
            return False
        here = self._here()
        if here is not None:
            here.copy_to_host()
        self._last = self._here = _return_none
        past = start.warm[BEFORE_KEY].T if has_warm_state(start.warm, last_u) else None
        self._frame.load_state(last_u, past, restore_history(cases, len(last_u)), self._get_updated_model(start.warm))
        return True

    def _get_updated_model(self, warm: Mapping[str, Any]) -> UpdatedModel | None:
        if isinstance(warm, DeviceWarmStart):
            return warm.bent
        part = self._frame.part
        return None if part is None else restore_updated_model(warm, self._problem.device, len(self._nodes), part.size)

    def _release_state(self) -> None:
        """Update the warm-start data before the next frame, which starts from the current state."""
        there, here = self._there(), self._here()
        if there is not None:
            there.copy_to_host()
        if here is not None and here.state is not None:
            here.state = self._frame.previous_state
        self._there = self._here


def build_frame_sequence(
    strategy: Strategy,
    space: Discretisation,
    surface: ContactSurface,
    diagnostics: Diagnostics,
    lock: RLock,
    source: str,
) -> FrameSequence:
    """Return the frame solver for pushes on a surface, from the strategy of a plan that captures frames."""
    problem, preconditioner, inversion = strategy.problem, strategy.preconditioner, strategy.inversion
    part = build_strained_part(problem, preconditioner, space) if strategy.plan.updates_model else None
    frame = CapturedFrame(problem, preconditioner, inversion, surface, strategy.accuracy.tolerance, part)
    return FrameSequence(problem, inversion, frame, diagnostics, lock, source)


def _return_none() -> None:
    """Return None, since no solution is on the device."""
