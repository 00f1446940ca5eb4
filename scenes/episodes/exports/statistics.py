"""Statistics of columns and names of tasks, as exports list them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..reading.contents import Contents

TASKS = {
    "press": "Press on one place of the open cortex, hold, and let go.",
    "slide": "Press, slide along a straight line over the open cortex, and let go.",
    "draw": "Lay the tool on the open cortex, and draw the tissue aside.",
    "reach": "Touch several places of the open cortex in turn, by smooth motions.",
    "walk": "Wander over the open cortex at random, always in contact.",
    "palpate": "Move a ball by its pose over the open cortex, to palpate it at several places.",
    "retract": "Draw the cortex aside with a spatula, and hold it while the tissue relaxes.",
    "drain": "Drain fluid and turn the head, while the brain sinks.",
    "debulk": "Cut the tumour out in shares.",
}
# Of so many bodies, or episodes where there are fewer bodies, one is held out.
HELD_OUT = 10


@dataclass(frozen=True, eq=False)
class Spread:
    """Of `count` rows: each a float64 array of one row's shape. What is not known, NaN, counts nowhere."""

    least: np.ndarray
    greatest: np.ndarray
    total: np.ndarray
    squares: np.ndarray
    known: np.ndarray
    count: int

    @classmethod
    def of(cls, rows: np.ndarray) -> Spread:
        """Of rows (T, ...)."""
        rows = np.asarray(rows, np.float64)
        known = ~np.isnan(rows)
        filled = np.where(known, rows, 0.0)
        return cls(
            np.where(known, rows, np.inf).min(axis=0),
            np.where(known, rows, -np.inf).max(axis=0),
            filled.sum(axis=0),
            np.square(filled).sum(axis=0),
            known.sum(axis=0),
            len(rows),
        )

    def __add__(self, other: Spread) -> Spread:
        """Of both."""
        return Spread(
            np.minimum(self.least, other.least),
            np.maximum(self.greatest, other.greatest),
            self.total + other.total,
            self.squares + other.squares,
            self.known + other.known,
            self.count + other.count,
        )

    def said(self) -> dict[str, list]:
        """As lists: min, max, mean, std and count; zeros where nothing is known."""
        known = np.maximum(self.known, 1)
        mean = self.total / known
        deviation = np.sqrt(np.maximum(self.squares / known - np.square(mean), 0.0))
        arrays = {"min": self.least, "max": self.greatest, "mean": mean, "std": deviation}
        lists = {name: np.where(self.known, array, 0.0) for name, array in arrays.items()}
        return {**{name: np.atleast_1d(array).tolist() for name, array in lists.items()}, "count": [self.count]}


def task_of(contents: Contents) -> str:
    """The sentence for an episode's family; of one that has none, its scene's name."""
    return TASKS.get(contents.family, f"Play the scene {contents.family}.")


def held_out(episodes: Sequence[Contents]) -> list[bool]:
    """Which episodes are for validation: every tenth body; of fewer than ten bodies, every tenth episode.

    Of two to nine episodes it is the last.
    """
    bodies = list(dict.fromkeys(str(one.said.get("anatomy")) for one in episodes))
    if len(bodies) < HELD_OUT:
        every = min(HELD_OUT, max(len(episodes), 2))
        return [number % every == every - 1 for number in range(len(episodes))]
    out = set(bodies[HELD_OUT - 1 :: HELD_OUT])
    return [str(one.said.get("anatomy")) in out for one in episodes]
