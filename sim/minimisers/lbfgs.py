"""L-BFGS from the rest stiffness on a batch of load cases, steered where the numbers are: the host only counts.

One iteration evaluates the gradient of every column at its own trial, accepts or cuts that, applies the preconditioner,
and aims anew. The launches are always the same, so that a graphics card replays them as one captured graph. Between
iterations the host drops the columns that have ended.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp

from ..arguments import is_all_finite
from ..discretisation.problem import Problem
from ..discretisation.term import Cases
from ..linalg.pcg import Preconditioner
from ..runtime.columns import EXACT, find_workspace_width, scatter_columns
from .lbfgs_kernels import LEFT, LIVE, PAIRS
from .lbfgs_state import Workspace, allocate_ground

# What a descent has learnt about the curvature, on the host, rows first: s and w (b, m, 3N), their products (b, m, m),
# the newest pair and how many there are (b,).
LEARNT = ("s", "w", "sy", "yw", "head", "known")
# Learnt curvature travels with the answers of so few load cases: a larger batch has no next frame.
CARRIED = EXACT


@dataclass(frozen=True)
class Schedule:
    """How often the host looks, and when columns that go on move to a narrower workspace.

    Parameters
    ----------
    between
        Iterations between two looks.
    smaller
        They move where that is at most this share as wide.
    """

    between: int = 1
    smaller: float = 0.85


ON_CUDA = Schedule(between=2, smaller=0.75)


@dataclass(frozen=True, eq=False)
class Descended:
    """u (3N, b) [m] on the device; (b,) on the host: status, accepted steps, relative residuals; what was `LEARNT`."""

    u: wp.array
    status: np.ndarray
    steps: np.ndarray
    residual: np.ndarray
    learnt: Mapping[str, np.ndarray]

    @property
    def left(self) -> np.ndarray:
        """(k,): columns whose descent did not end, and another may go on with."""
        return np.flatnonzero((self.status == LIVE) | (self.status == LEFT))


class Lbfgs:
    """L-BFGS on one problem. What the widest batch worked in is kept for the next ones.

    Parameters
    ----------
    problem
        Whose potential is minimised.
    preconditioner
        Of this problem at rest.
    schedule
        Of the host; None: as serves the device.
    """

    def __init__(self, problem: Problem, preconditioner: Preconditioner, schedule: Schedule | None = None):
        self._problem = problem
        self._schedule = schedule or (ON_CUDA if problem.device.on_cuda else Schedule())
        self._preconditioner = preconditioner
        self._workspaces: dict[int, Workspace] = {}
        self._ground: dict[str, wp.array] = {}

    @property
    def held(self) -> int:
        """Bytes that are kept."""
        return sum(array.capacity for array in self._ground.values())

    def descend(
        self,
        start: wp.array,
        tolerance: np.ndarray,
        most: int,
        learnt: Mapping[str, np.ndarray] | None = None,
        force: np.ndarray | None = None,
        stragglers: float = 0.0,
        ahead: tuple[wp.array, wp.array] | None = None,
    ) -> Descended:
        """Minimise the potential of the batch that the problem has begun, from start (3N, b) [m], in `most` iterations.

        The start satisfies the constraints, and no footprint is moved. A column ends at its tolerance (b,), relative as
        `Problem.residual` has it, or where the free gradient's 2-norm is at most force (b,) [N]. `learnt` is what an
        earlier descent of the same problem found out, near here it is hoped, if any; None: the next one learns nothing
        from this one either. The descent stops where at most the share `stragglers` of all columns is still on its way.
        `ahead` is what is known of the start: the free gradient and, preconditioned, the same (3N, b). Every u is the
        last accepted state of its column.
        """
        device, count = self._problem.device, start.shape[1]
        u, place = wp.clone(start), np.arange(count)
        status, steps, residual = np.full(count, LIVE), np.zeros(count, int), np.full(count, np.inf)
        carried = learnt is not None and count <= CARRIED
        if count == 0:
            return Descended(u, status, steps, residual, {})
        workspace, tried = self._workspace(count), 0
        workspace.begin(
            start, tolerance, np.zeros(count) if force is None else force, (learnt or {}) if count <= CARRIED else {}
        )
        if ahead is not None:
            workspace.aim(*ahead)
        while True:
            more = min(self._schedule.between, most - tried)
            workspace.turn(more)
            tried += more
            now = workspace.columns["status"].numpy()[: len(place)]
            left = int((now == LIVE).sum())
            last = tried >= most or left <= stragglers * count
            if last or (count > CARRIED and self._width(left) <= self._schedule.smaller * workspace.width):
                leave = np.flatnonzero(now != LIVE) if not last else np.arange(len(now))
                there = place[leave]
                scatter_columns(device, workspace.columns["u"], there, u, leave)
                status[there], steps[there], residual[there] = (
                    workspace.columns[name].numpy()[leave] for name in ("status", "steps", "residual")
                )
                if last:
                    learnt = {name: to_rows_first(workspace.columns[name]) for name in LEARNT} if carried else {}
                    return Descended(u, status, steps, residual, learnt)
                stay = np.flatnonzero(now == LIVE)
                place, before, workspace = place[stay], workspace, self._workspace(len(stay))
                workspace.take(before, stay)

    def _workspace(self, count: int) -> Workspace:
        """For so many columns or a few more."""
        width = self._width(count)
        if width > max(self._workspaces, default=0):
            self._workspaces, self._ground = {}, {}  # what is there is given back before more is taken
            self._ground = allocate_ground(self._problem, width)
        if width not in self._workspaces:
            self._workspaces[width] = Workspace(self._problem, self._preconditioner, width, self._ground)
        return self._workspaces[width]

    def _width(self, count: int) -> int:
        return find_workspace_width(self._problem.device, count)


def to_rows_first(array: wp.array) -> np.ndarray:
    """Return a copy (b, ...) on the host of an array (..., b) in a workspace."""
    return np.moveaxis(array.numpy(), -1, 0).copy()  # what stands in a workspace is written over


def restore_history(cases: Cases, rows: int) -> dict[str, np.ndarray]:
    """What an earlier descent on as many rows = 3N left warm; nothing if that does not fit these cases.

    It only shortens the way: what holds numbers that are not finite is forgotten.
    """
    if any(name not in cases.warm for name in LEARNT):
        return {}
    found = {name: np.asarray(cases.warm[name]) for name in LEARNT}
    shape = {"s": (PAIRS, rows), "w": (PAIRS, rows), "sy": (PAIRS, PAIRS), "yw": (PAIRS, PAIRS)}
    if any(array.shape != (len(cases.loads), *shape.get(name, ())) for name, array in found.items()):
        return {}
    most = {"head": PAIRS - 1, "known": PAIRS}
    if any(array.dtype.kind not in "fiu" for array in found.values()) or not all(
        ((found[name] >= 0) & (found[name] <= last)).all() for name, last in most.items()
    ):
        return {}
    # Other places hold whatever stood in the workspace.
    used = (found["head"][:, None] - np.arange(PAIRS)) % PAIRS < found["known"][:, None]
    places = {"s": used, "w": used} | dict.fromkeys(("sy", "yw"), used[:, :, None] & used[:, None, :])
    return found if all(is_all_finite(found[name][place]) for name, place in places.items()) else {}
