"""What the page showed for some seconds, kept as it was sent, and made into a film."""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from ..screen import write_film

LONGEST, LARGEST = 60.0, 64_000_000
"""A recording ends by itself after so long [s], or so many characters of coded pictures."""
RATE = 15.0
"""Pictures per second of a film."""


@dataclass
class Recording:
    """Pictures as `coded` writes them, each with the time [s] when it came."""

    began: float
    taken: list[tuple[float, str]] = field(default_factory=list)
    size: int = 0

    def take(self, code: str, now: float) -> None:
        """Keep a picture, unless it is the last one still, or the recording is full."""
        if (not self.taken or self.taken[-1][1] is not code) and not self.full(now):
            self.taken.append((now, code))
            self.size += len(code)

    def full(self, now: float) -> bool:
        """Whether no more is kept."""
        return now - self.began >= LONGEST or self.size >= LARGEST

    def film(self, ended: float) -> bytes:
        """An MP4 of what was shown until then, as long as that took; the pictures have the size of the first.

        Raises
        ------
        ValueError
            Nothing was shown.
        OSError
            There is no room for it on the disk.
        """
        with tempfile.TemporaryDirectory(prefix="sulcus-") as folder:
            path = Path(folder) / "page.mp4"
            write_film(path, played(self.taken, min(ended, self.began + LONGEST), RATE), RATE)
            return path.read_bytes()


def played(taken: Sequence[tuple[float, str]], ended: float, rate: float) -> Iterator[np.ndarray]:
    """The picture (H, W, 3) uint8 that was shown at each step of a clock of so many steps a second."""
    size: tuple[int, int] | None = None
    for number, (began, code) in enumerate(taken):
        until = taken[number + 1][0] if number + 1 < len(taken) else max(ended, began)
        # So many steps lie before each end: the film is as long as what it shows.
        start, stop = (round((time - taken[0][0]) * rate) for time in (began, until))
        if number + 1 == len(taken):
            stop = max(stop, start + 1)
        if stop == start:
            continue
        colour = decoded(code)
        size = size or (colour.shape[1], colour.shape[0])
        if (colour.shape[1], colour.shape[0]) != size:
            colour = cv2.resize(colour, size, interpolation=cv2.INTER_AREA)
        for _ in range(stop - start):
            yield colour


def decoded(code: str) -> np.ndarray:
    """The picture (H, W, 3) uint8 of an address that `coded` wrote."""
    written = np.frombuffer(base64.b64decode(code.partition(",")[2]), np.uint8)
    return cv2.cvtColor(cv2.imdecode(written, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)  # type: ignore[arg-type]
