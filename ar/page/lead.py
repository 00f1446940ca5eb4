"""Who of a page's visitors leads: what they set is heard, and the others look on until they are let lead."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

IDLE = 60.0
"""A leader who has set nothing for so long [s] hands over as soon as somebody asks."""


@dataclass
class Lead:
    """The leader's number, when they last set something [s], and who asks to lead, in that order."""

    leader: int | None = None
    acted: float = 0.0
    asking: tuple[int, ...] = ()

    def see(self, here: Collection[int], now: float) -> None:
        """Note who is here: if the leader has left, who asked first leads, or who has been here longest."""
        self.asking = tuple(visitor for visitor in self.asking if visitor in here)
        if self.leader not in here:
            self._pass((*self.asking, *sorted(here), None)[0], now)

    def act(self, visitor: int, now: float) -> bool:
        """Note that a visitor sets something; whether it is heard."""
        if visitor == self.leader:
            self.acted = now
        return visitor == self.leader

    def ask(self, visitor: int, now: float) -> None:
        """Note that a visitor asks to lead."""
        if visitor == self.leader or visitor in self.asking:
            return
        self.asking += (visitor,)
        if now - self.acted >= IDLE:
            self.give(now)

    def give(self, now: float) -> None:
        """Let the visitor lead who asked first."""
        if self.asking:
            self._pass(self.asking[0], now)

    def _pass(self, visitor: int | None, now: float) -> None:
        self.leader, self.acted = visitor, now
        self.asking = tuple(other for other in self.asking if other != visitor)

    def words(self, visitor: int, here: Collection[int]) -> str:
        """What a visitor reads of it, in Markdown; nothing where they are alone."""
        if len(here) < 2:
            return ""
        if visitor == self.leader:
            asked = f" **Visitor {self.asking[0]} asks to lead.**" if self.asking else ""
            return f"You lead: the others look on.{asked}"
        waits = " You have asked to lead." if visitor in self.asking else ""
        return f"Another visitor (number {self.leader}) leads: what you set here is put back.{waits}"
