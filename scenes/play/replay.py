"""Frames of a run in any requested order, each computed from another frame near it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from sim.deformation import Deformation
from sim.effects import SkullContact

from ..script.tool_paths import Touch
from .player import Player

T = TypeVar("T")  # Type of a frame.
# Largest time step of one solve where the brain separates from the skull [s]. One long solve costs half as much as the
# steps that show its course, but takes a quarter of a minute without an image.
MAX_TIME_STEP = 0.2


@dataclass(frozen=True)
class ReplayOrder:
    """Order in which frames are computed from other frames.

    Parameters
    ----------
    max_step
        Maximum number of frames of one step. Longer distances are split at its multiples.
    backward
        True if a frame may be computed from a later one.
    max_stored
        Number of solutions kept of a run, evenly spaced, to limit recomputation.
    """

    max_step: int = 1
    backward: bool = False
    max_stored: int = 16


IN_ORDER = ReplayOrder()
"""Each frame depends on the previous one. Stored solutions take 2 MB each with relaxing tissue on the default brain,
and ten times as much on quadratic elements.
"""


class FrameCache(Generic[T]):
    """Frames of a run in any order. Frame n equals that of the sequential run 0 ... n, regardless of earlier requests.

    Parameters
    ----------
    frames
        Number of frames.
    step
        Function from a frame's number and the preceding frame (None: the state before the first) to the frame.
    course
        Order in which frames are computed.
    """

    def __init__(self, count: int, compute_frame: Callable[[int, T | None], T], order: ReplayOrder = IN_ORDER) -> None:
        self._step, self._course = compute_frame, order
        self._every = order.max_step * -(-count // (order.max_step * order.max_stored))
        self.kept: dict[int, T] = {}
        """Frames that are not run again, by number."""
        self._last: dict[int, T] = {}

    def approach_frame(self, frame_number: int) -> tuple[int, T]:
        """Take at most one step towards a frame; return the number and the frame that is reached."""
        computed = self.kept | self._last
        starts = computed if self._course.backward else [other for other in computed if other <= frame_number]
        reached = min(starts, key=lambda other: abs(frame_number - other), default=-1)
        if reached != frame_number:
            before, reached = computed.get(reached), self._find_step_end(reached, frame_number)
            computed = {reached: self._step(reached, before)}
            if reached % self._every == 0:
                self.kept |= computed
        self._last = {reached: computed[reached]}
        return reached, computed[reached]

    def _find_step_end(self, start: int, number: int) -> int:
        """Return the frame at which a step from `start` towards a frame ends."""
        leap = self._course.max_step
        if start < number:
            return min(number, (start // leap + 1) * leap)
        return max(number, -(-start // leap) * leap - leap)


class ReplaySession:
    """FEM solutions for users who scrub through a script or control its tool.

    With history-dependent solutions, a frame of the script is that of the sequential run. Manual control continues
    from the last solution: each of its frames is one frame period later, regardless of its number. If the brain
    separates from the skull, a jump passes through frames in between.
    """

    def __init__(self, player: Player) -> None:
        self.player = player
        course, scene = plan_replay_order(player), player.scene
        self._reel: FrameCache[Deformation] | None = None
        if course is not None:
            self._reel = FrameCache(
                len(scene.times),
                lambda number, last: player.compute_deformation(player.build_loads(number), last),
                course,
            )
        self._last: Deformation | None = None

    def approach_frame(self, frame_number: int, touch: Touch | None = None) -> tuple[int, Deformation]:
        """Return number and solution of a frame, or of one on the way to it; `touch` under manual control."""
        player, last = self.player, self._last
        if self._reel is not None and touch is None:
            frame_number, self._last = self._reel.approach_frame(frame_number)
            return frame_number, self._last
        loads = player.build_loads(frame_number, touch)
        if player.remembers and last is not None:
            last = replace(last, time=loads.times - 1.0 / player.scene.frames_per_second)
        self._last = player.compute_deformation(loads, last)
        return frame_number, self._last


def plan_replay_order(player: Player) -> ReplayOrder | None:
    """Return the order in which frames of a script are computed; None if all are independent."""
    scene = player.scene
    if player.remembers:
        return IN_ORDER
    if not any(isinstance(effect, SkullContact) for effect in scene.get_effects_on(player.site.anatomy)):
        return None
    # Only displacements of states with skull contact are stored, a third of a megabyte each.
    return ReplayOrder(max(1, round(MAX_TIME_STEP * scene.frames_per_second)), backward=True, max_stored=64)
