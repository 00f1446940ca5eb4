"""Videos and images of a camera: whether they fit its calibration, and views of the calibration board."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np

from ar.optics.calibration import Calibration
from ar.tracking.board_views import View, find_board
from ar.tracking.focal_fit import focal_fit
from ar.tracking.pictures import GIVE, film_of, length_of, pictures_of
from ar.tracking.targets import Detector, Target, all_targets
from ar.tracking.track import demand_picture
from sim.errors import InputError
from sim.runtime.outside_files import read_as

from .run import Timed, timed

# Of the first pictures of a film one in so many is looked at.
LOOKED, EACH = 120, 10


def demand_film(film: Path, rate: float, calibration: Calibration, camera: str) -> None:
    """Refuse what is no film, or one of another camera, by its first pictures: before anything that takes long.

    Without markers nothing is known of its focal length.

    Parameters
    ----------
    film, rate
        A video, or a folder of pictures with so many a second.
    camera
        Name of the calibration's file.

    Raises
    ------
    InputError
        No such film, none that can be read, pictures of another size than the camera's, and focal lengths that are
        surely off by more than 5 %.
    """
    targets = {target.name: target for target in all_targets()}
    detector, seen, count = Detector(tuple(targets.values())), [], 0
    with read_as(film, "a film", GIVE):
        try:
            for picture in islice(film_of(film, rate), 0, LOOKED, EACH):
                demand_picture(picture.grey, calibration.width, calibration.height)
                seen += [(targets[name], corners) for name, corners in detector.seen(picture.grey).items()]
                count += 1
        except ValueError as error:
            raise InputError(str(error)) from error
    if not count:
        raise InputError(f"{film}: holds no picture. {GIVE}")
    fit = focal_fit(calibration.camera(np.eye(4)), seen)
    if fit is not None and fit.differs:
        way = "longer" if fit.factor > 1.0 else "shorter"
        raise InputError(
            f"{film}: its markers are seen with focal lengths that are {abs(fit.factor - 1.0):.0%} {way} "
            f"(+- {fit.deviation:.1%}) than {camera} states. It is of another camera or zoom: calibrate this one by "
            "`sulcus calibrate`."
        )


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


@dataclass(frozen=True)
class Seen:
    """What was seen of the board.

    Parameters
    ----------
    views
        Of the pictures that show it.
    width, height
        Of all pictures [pixel].
    looked_at
        How many pictures there were.
    """

    views: tuple[View, ...]
    width: int
    height: int
    looked_at: int


def seen_views(path: Path, board: Target, size: tuple[int, int] | None = None) -> Seen:
    """The board in each picture of a folder or a video; `size` is the width and height that they must have.

    Raises
    ------
    InputError
        What cannot be read, pictures of different sizes or of another one than stated, or a board that is not seen.
    """
    views, count, first, detector = [], 0, "", Detector([board])
    with read_as(path, "pictures of a board", GIVE):
        try:
            for picture in pictures_of(path):
                count += 1
                found = (picture.grey.shape[1], picture.grey.shape[0])
                if size is not None and found != size:
                    than = f"{first} {size[0]} x {size[1]}" if first else f"{size[0]} x {size[1]} was stated"
                    raise InputError(
                        f"{picture.name} has {found[0]} x {found[1]} pixels, but {than}: "
                        "calibrate with pictures of one size, which is that of later use."
                    )
                size, first = found, first or f"{picture.name} has"
                view = find_board(detector, picture.name, picture.grey)
                views += [] if view is None else [view]
        except ValueError as error:
            raise InputError(str(error)) from error
    if size is None or not count:
        raise InputError(f"{path}: holds no pictures. {GIVE}")
    if not views:
        raise InputError(
            f"{path}: the board is in none of {count} pictures: print it by `sulcus markers`, and show most of it."
        )
    return Seen(tuple(views), *size, count)
