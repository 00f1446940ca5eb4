"""Detection of the calibration board in a folder of images or a video."""

from dataclasses import dataclass
from pathlib import Path

from ar.tracking.image_sequences import REMEDY, read_images
from ar.tracking.intrinsics import BoardView, find_board
from ar.tracking.targets import Detector, Target
from sim.errors import InputError
from sim.runtime.outside_files import wrap_errors


@dataclass(frozen=True)
class BoardDetections:
    """Detections of the calibration board in a set of images.

    Parameters
    ----------
    views
        Detected views of the board, one for each image that shows the board.
    width, height
        Size of all images [pixel].
    image_count
        Number of examined images.
    """

    views: tuple[BoardView, ...]
    width: int
    height: int
    image_count: int


def detect_board(path: Path, board: Target, size: tuple[int, int] | None = None) -> BoardDetections:
    """Detect the board in each image of a folder or a video; `size` is the required width and height.

    Raises
    ------
    InputError
        The input is not readable, images differ in size or do not have the required size, or no board is visible.
    """
    views, count, first, detector = [], 0, "", Detector([board])
    with wrap_errors(path, "images of a board", REMEDY):
        try:
            for picture in read_images(path):
                count += 1
                found = (picture.grey.shape[1], picture.grey.shape[0])
                if size is not None and found != size:
                    than = f"{first} {size[0]} x {size[1]}" if first else f"{size[0]} x {size[1]} was given"
                    raise InputError(
                        f"{picture.name} has {found[0]} x {found[1]} pixels, but {than}: "
                        "calibrate with images of one size, which is that of later use."
                    )
                size, first = found, first or f"{picture.name} has"
                view = find_board(detector, picture.name, picture.grey)
                views += [] if view is None else [view]
        except ValueError as error:
            raise InputError(str(error)) from error
    if size is None or not count:
        raise InputError(f"{path}: holds no images. {REMEDY}")
    if not views:
        raise InputError(
            f"{path}: the board is in none of {count} images: print it by `sulcus markers`, and show most of it."
        )
    return BoardDetections(tuple(views), *size, count)
