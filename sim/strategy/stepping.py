"""How load steps grow and shrink, and how the gaps of tools are opened for a long way."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Stepping:
    """How load steps grow, shrink and end.

    Parameters
    ----------
    first, least, cut
        Shares of the load: of the first step, of the shortest, and what is left of a step that failed.
    aimed, most
        The next step is as long as lets expect so many outer iterations. One that takes more than the most is too long.
    patience
        Steps end when the batch has spent so many times the linear iterations that one outer iteration may take.
    """

    first: float = 1.0 / 4.0
    least: float = 1.0 / 64.0
    cut: float = 1.0 / 4.0
    aimed: int = 8
    most: int = 15
    patience: int = 4


STEPPING = Stepping()


@dataclass(frozen=True)
class Gaps:
    """How the gap of tools is opened for a long way, and closed again.

    Parameters
    ----------
    wide_enough, closing
        Tools that go farther than so many gaps at once begin with a gap that is wider by a power of the closing.
    tolerance
        To which tissue is solved until the gap is the tools' own.
    wider
        A step that failed is tried again, shorter, from a gap so many times as wide.
    alone, nearly
        Contact is solved apart in so many iterations first. Where that ends so near, Newton goes on in as many.
    """

    wide_enough: float = 8.0
    closing: float = 4.0
    tolerance: float = 0.05
    wider: float = 16.0
    alone: int = 60
    nearly: float = 0.1


GAPS = Gaps()
