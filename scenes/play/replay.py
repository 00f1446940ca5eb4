"""Frames of a run in any requested order, each computed from a frame with a near number."""

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
    """Rules by which frames are computed from other frames.

    Parameters
    ----------
    max_step
        Maximum number of frames of one step. A longer distance is split at multiples of `max_step`.
    backward
        True if a frame may be computed from a later frame.
    max_stored
        Number of evenly spaced solutions of a run that are stored, to limit recomputation.
    """

    max_step: int = 1
    backward: bool = False
    max_stored: int = 16


IN_ORDER = ReplayOrder()
"""Each frame depends on the previous one. Stored solutions take 2 MB each with relaxing tissue on the default brain,
and ten times as much on quadratic elements.
"""


class FrameCache(Generic[T]):
    """Cache that returns frames of a run in any order.

    Parameters
    ----------
    count
        Number of frames.
    compute_frame
        Function that computes a frame from its number and its start frame (None: the state before frame 0).
    order
        Rules by which frames are computed from other frames. With `IN_ORDER`, frame n is that of the run 0 ... n.
    """

    def __init__(self, count: int, compute_frame: Callable[[int, T | None], T], order: ReplayOrder = IN_ORDER) -> None:
        self._step, self._course = compute_frame, order
        self._every = order.max_step * -(-count // (order.max_step * order.max_stored))
        self.kept: dict[int, T] = {}
        """Stored frames, by number."""
        self._last: dict[int, T] = {}

    def approach_frame(self, frame_number: int) -> tuple[int, T]:
        """Compute at most one step towards a frame; return the number of the reached frame, and this frame."""
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
        """Return the frame number at which a step from `start` towards frame `number` ends."""
        leap = self._course.max_step
        if start < number:
            return min(number, (start // leap + 1) * leap)
        return max(number, -(-start // leap) * leap - leap)


class ReplaySession:
    """Solutions for a user who jumps between the frames of a script or controls the tool manually.

    If solutions depend on the history, a scripted frame equals that of the sequential run. Manual control continues
    from the last solution: each new frame is one frame period later, regardless of its number. If the brain can
    separate from the skull, a jump computes frames in between.
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
        """Return number and solution of a frame, or of a frame in between; `touch` is the input of manual control."""
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
    """Return the order in which frames of a script are computed; None if all frames are independent."""
    scene = player.scene
    if player.remembers:
        return IN_ORDER
    if not any(isinstance(effect, SkullContact) for effect in scene.get_effects_on(player.site.anatomy)):
        return None
    # Only displacements of states with skull contact are stored, a third of a megabyte each.
    return ReplayOrder(max(1, round(MAX_TIME_STEP * scene.frames_per_second)), backward=True, max_stored=64)
