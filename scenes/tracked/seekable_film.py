"""The pictures of a film by their numbers, for who goes to and fro in it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from ar.tracking.pictures import film_of, length_of

from .run import Timed, timed


@dataclass(eq=False)
class SeekableFilm:
    """A video, or a folder of pictures.

    Parameters
    ----------
    path
        As `ar.tracking.pictures.film_of` has it; so are the errors.
    rate
        Pictures in a second, of a folder.
    count
        How many pictures there are, as far as is known.
    """

    path: Path
    rate: float
    count: int = field(init=False)
    film: Iterator[Timed] = field(init=False)
    next: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        """Open it."""
        self.count = length_of(self.path)
        self.film = self._from(0)

    def _from(self, number: int) -> Iterator[Timed]:
        return timed(film_of(self.path, self.rate, colour=True, first=number))

    def at(self, number: int) -> Timed | None:
        """A picture by its number; None where the film ends before it, which `count` says from then on."""
        if number != self.next:
            # From its start: a video's own leaps do not land on every frame.
            self.film = self._from(number)
        found, self.next = next(self.film, None), number + 1
        if found is None:
            self.count, self.next = min(self.count, number), -1
        return found
