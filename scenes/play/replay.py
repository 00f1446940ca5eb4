"""Frames asked for in any order, of a run in which each may depend on the one before it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Generic, TypeVar

from sim.deformation import Deformation

from ..script.tool_paths import Touch
from .player import Player

T = TypeVar("T")
# Answers that are kept of a run, evenly over it, so that little is run again: two megabytes each where the default
# brain relaxes, and quadratic elements ten times as much.
KEPT = 16


class Reel(Generic[T]):
    """Frame n of a run is what the straight run 0 ... n gives, whatever was asked for before.

    Parameters
    ----------
    frames
        How many there are.
    step
        A frame's number and the frame before it (None: before the first) -> the frame.
    """

    def __init__(self, frames: int, step: Callable[[int, T | None], T]) -> None:
        self._every, self._step = -(-frames // KEPT), step
        self.kept: dict[int, T] = {}
        """Frames that are not run again, by number."""
        self._last: dict[int, T] = {}

    def towards(self, number: int) -> tuple[int, T]:
        """The frame, or one nearer to it, and its number: a call takes one step at most."""
        known = self.kept | self._last
        nearest = max((other for other in known if other <= number), default=-1)
        if nearest < number:
            before, nearest = known.get(nearest), nearest + 1
            known = {nearest: self._step(nearest, before)}
            if nearest % self._every == 0:
                self.kept |= known
        self._last = {nearest: known[nearest]}
        return nearest, known[nearest]


class Session:
    """What one player answers visitors, who scrub through its script or take its tool over.

    Where answers depend on those before them, a frame of the script is that of the straight run. A hand goes on from
    the last answer: each of its frames is one frame's time later than that, whichever number it has.
    """

    def __init__(self, player: Player) -> None:
        self.player = player
        self._reel: Reel[Deformation] = Reel(
            len(player.scene.times), lambda number, last: player.answer(player.loads(number), last)
        )
        self._last: Deformation | None = None

    def towards(self, number: int, touch: Touch | None = None) -> tuple[int, Deformation]:
        """A frame's answer, or that of one on the way to it, and its number; `touch` where the hand has the tool."""
        player, last = self.player, self._last
        if player.remembers and touch is None:
            number, self._last = self._reel.towards(number)
            return number, self._last
        loads = player.loads(number, touch)
        if player.remembers and last is not None:
            last = replace(last, time=loads.times - 1.0 / player.scene.frames_per_second)
        self._last = player.answer(loads, last)
        return number, self._last
