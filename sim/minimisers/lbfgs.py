"""L-BFGS for a batch of load cases, with the undeformed stiffness as initial Hessian, and decisions on the device.

One iteration evaluates the gradient of each load case at its own trial step, accepts the step or backtracks, applies
the preconditioner and computes the next direction. All iterations have the same launches, so that a GPU replays a
captured graph. Between iterations, the host removes load cases that have ended.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp

from ..arguments import is_all_finite
from ..discretisation.problem import Problem
from ..discretisation.term import Cases
from ..linalg.pcg import Preconditioner
from ..runtime.columns import MAX_EXACT, find_workspace_width, scatter_columns
from .lbfgs_kernels import LIVE, PAIRS, STOPPED
from .lbfgs_state import LbfgsWorkspace, allocate_memory

# L-BFGS history of a descent on the host, load cases first: s and w (b, m, 3N), products (b, m, m), slot of the newest
# pair and number of pairs (b,).
HISTORY_KEYS = ("s", "w", "sy", "yw", "head", "known")
MAX_CARRIED = MAX_EXACT  # Largest batch [load cases] that hands its history on: a larger one has no next frame.


@dataclass(frozen=True)
class CheckSchedule:
    """Interval between checks by the host, and criterion to move unfinished load cases to a narrower workspace.

    Parameters
    ----------
    check_interval
        Number of iterations between two checks.
    width_ratio
        Load cases move if the narrower width is at most this fraction of the current width.
    """

    check_interval: int = 1
    width_ratio: float = 0.85


CUDA_SCHEDULE = CheckSchedule(check_interval=2, width_ratio=0.75)  # A check stalls the GPU.


@dataclass(frozen=True, eq=False)
class DescentResult:
    """Result of a descent: u (3N, b) [m] on the device; status, steps, relative residuals (b,) on the host; history."""

    u: wp.array
    status: np.ndarray
    steps: np.ndarray
    residual: np.ndarray
    warm_start: Mapping[str, np.ndarray]

    @property
    def unfinished_cases(self) -> np.ndarray:
        """Numbers (k,) of the load cases that did not end; another method can continue these."""
        return np.flatnonzero((self.status == LIVE) | (self.status == STOPPED))


class Lbfgs:
    """L-BFGS solver for one problem. The memory of the widest batch is kept for later batches.

    Parameters
    ----------
    problem
        Problem whose potential is minimised.
    preconditioner
        Preconditioner of the problem in the undeformed configuration.
    schedule
        Schedule of the checks by the host; None: a device-dependent default.
    """

    def __init__(self, problem: Problem, preconditioner: Preconditioner, schedule: CheckSchedule | None = None):
        self._problem = problem
        self._schedule = schedule or (CUDA_SCHEDULE if problem.device.on_cuda else CheckSchedule())
        self._preconditioner = preconditioner
        self._workspaces: dict[int, LbfgsWorkspace] = {}
        self._ground: dict[str, wp.array] = {}

    @property
    def kept_bytes(self) -> int:
        """Size of the memory that is kept between batches [bytes]."""
        return sum(array.capacity for array in self._ground.values())

    def descend(
        self,
        start: wp.array,
        tolerance: np.ndarray,
        max_iter: int,
        history: Mapping[str, np.ndarray] | None = None,
        force_tolerance: np.ndarray | None = None,
        straggler_fraction: float = 0.0,
        initial_residual: tuple[wp.array, wp.array] | None = None,
    ) -> DescentResult:
        """Minimise the energy of the current batch from `start` (3N, b) [m], in at most `max_iter` iterations.

        The start must satisfy the constraints, and no footprint may have a prescribed motion. A load case ends if its
        relative residual, as in `Problem.residual`, is at most `tolerance` (b,), or its 2-norm at most
        `force_tolerance` (b,) [N]. `history` is from an earlier descent of the problem near this state, or empty; None:
        no history is returned. The descent stops if at most the fraction `straggler_fraction` of the load cases is
        unfinished. `initial_residual` is the residual at the start and its preconditioned form, both (3N, b), if
        available. The returned u is the last accepted state of each load case.
        """
        device, count = self._problem.device, start.shape[1]
        u, place = wp.clone(start), np.arange(count)
        status, steps, residual = np.full(count, LIVE), np.zeros(count, int), np.full(count, np.inf)
        carried = history is not None and count <= MAX_CARRIED
        if count == 0:
            return DescentResult(u, status, steps, residual, {})
        workspace, tried = self._get_workspace(count), 0
        workspace.begin(
            start,
            tolerance,
            np.zeros(count) if force_tolerance is None else force_tolerance,
            (history or {}) if count <= MAX_CARRIED else {},
        )
        if initial_residual is not None:
            workspace.set_direction(*initial_residual)
        while True:
            more = min(self._schedule.check_interval, max_iter - tried)
            workspace.iterate(more)
            tried += more
            now = workspace.columns["status"].numpy()[: len(place)]
            left = int((now == LIVE).sum())
            last = tried >= max_iter or left <= straggler_fraction * count
            if last or (count > MAX_CARRIED and self._find_width(left) <= self._schedule.width_ratio * workspace.width):
                leave = np.flatnonzero(now != LIVE) if not last else np.arange(len(now))
                there = place[leave]
                scatter_columns(device, workspace.columns["u"], there, u, leave)
                status[there], steps[there], residual[there] = (
                    workspace.columns[name].numpy()[leave] for name in ("status", "steps", "residual")
                )
                if last:
                    history = {name: to_rows_first(workspace.columns[name]) for name in HISTORY_KEYS} if carried else {}
                    return DescentResult(u, status, steps, residual, history)
                stay = np.flatnonzero(now == LIVE)
                place, before, workspace = place[stay], workspace, self._get_workspace(len(stay))
                workspace.take_columns(before, stay)

    def _get_workspace(self, count: int) -> LbfgsWorkspace:
        """Return a workspace for `count` load cases or slightly more."""
        width = self._find_width(count)
        if width > max(self._workspaces, default=0):
            self._workspaces, self._ground = {}, {}  # free the old memory before more is allocated
            self._ground = allocate_memory(self._problem, width)
        if width not in self._workspaces:
            self._workspaces[width] = LbfgsWorkspace(self._problem, self._preconditioner, width, self._ground)
        return self._workspaces[width]

    def _find_width(self, count: int) -> int:
        return find_workspace_width(self._problem.device, count)


def to_rows_first(array: wp.array) -> np.ndarray:
    """Return a copy (b, ...) on the host of an array (..., b) in a workspace."""
    return np.moveaxis(array.numpy(), -1, 0).copy()  # the workspace will be overwritten


def restore_history(cases: Cases, rows: int) -> dict[str, np.ndarray]:
    """Return the L-BFGS history of an earlier descent with `rows` = 3N unknowns; empty if it does not fit the cases.

    A history with values that are not finite is dropped, since it only saves iterations.
    """
    if any(name not in cases.warm for name in HISTORY_KEYS):
        return {}
    found = {name: np.asarray(cases.warm[name]) for name in HISTORY_KEYS}
    shape = {"s": (PAIRS, rows), "w": (PAIRS, rows), "sy": (PAIRS, PAIRS), "yw": (PAIRS, PAIRS)}
    if any(array.shape != (len(cases.loads), *shape.get(name, ())) for name, array in found.items()):
        return {}
    most = {"head": PAIRS - 1, "known": PAIRS}
    if any(array.dtype.kind not in "fiu" for array in found.values()) or not all(
        ((found[name] >= 0) & (found[name] <= last)).all() for name, last in most.items()
    ):
        return {}
    # Other slots hold arbitrary values.
    used = (found["head"][:, None] - np.arange(PAIRS)) % PAIRS < found["known"][:, None]
    places = {"s": used, "w": used} | dict.fromkeys(("sy", "yw"), used[:, :, None] & used[:, None, :])
    return found if all(is_all_finite(found[name][place]) for name, place in places.items()) else {}
