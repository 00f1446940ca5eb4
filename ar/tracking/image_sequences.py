"""Image sequences of one camera from a folder or a video of unknown origin, grey or in colour."""

import os
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from ..optics.calibration import MAX_IMAGE_SIDE

MAX_IMAGES = 300  # Maximum number of images read by `read_images`, evenly spread.
MAX_PIXELS = 64_000_000  # Maximum number of pixels of an image.
MAX_FILE_BYTES = 256_000_000  # Maximum size of an image file [bytes].
NUMBER_PATTERN = re.compile(r"([0-9]+)")  # Pattern of a number in a file name, to sort by.
SUFFIXES = (".png", ".jpg", ".jpeg")  # Endings of image files.
VIDEO_STRIDE = 5  # Stride of the frames read from a video of unknown length.
REMEDY = "Give a video, or a folder of PNG or JPEG images."  # Remedy in error messages.
# Signatures of video files: MP4 and MOV (after four bytes), AVI, Matroska and WebM.
VIDEO_SIGNATURES = (b"ftyp", b"RIFF", b"\x1aE\xdf\xa3")
TOO_LARGE_ERROR = (
    "has more pixels than a camera gives. Write it smaller."  # Error message of an image with too many pixels.
)


@dataclass(frozen=True, eq=False)
class NamedImage:
    """Image with a name and a time.

    Parameters
    ----------
    name
        File name, or number of the video frame.
    grey
        Grey image (H, W) uint8.
    time
        Time [s] in the video or sequence; 0 for a single file.
    colour
        Colour image (H, W, 3) uint8 sRGB; None if not requested.
    """

    name: str
    grey: np.ndarray
    time: float = 0.0
    colour: np.ndarray | None = None


def read_images(path: Path) -> Iterator[NamedImage]:
    """Read at most `MAX_IMAGES` images of a folder (PNG, JPEG) or frames of a video, evenly spread, in order.

    Raises
    ------
    ValueError
        The file does not exist, the folder has no images, a file is not a readable video or image, or is too large.
    """
    if path.is_dir():
        files = _list_files(path)
        return (NamedImage(files[index].name, _read_image(files[index])) for index in _select_image_numbers(len(files)))
    return islice(_read_video_frames(path, None), MAX_IMAGES)


def read_video(path: Path, rate: float, with_colour: bool = False, first_frame: int = 0) -> Iterator[NamedImage]:
    """Read all images of a video or a folder from image `first_frame` on, with their times [s].

    Images of a folder are ordered by the numbers in their names. Pixels are used as stored: orientation metadata of
    videos and EXIF are ignored.

    `rate` is the frame rate [1/s] of a folder; a video has its own times. If `with_colour`, images also have colour.

    Raises
    ------
    ValueError
        See `read_images`.
    """
    if path.is_dir():
        files = islice(enumerate(_list_files(path)), first_frame, None)
        if with_colour:
            return (to_named_image(file.name, _read_image(file, "RGB"), number / rate) for number, file in files)
        return (NamedImage(file.name, _read_image(file), number / rate) for number, file in files)
    return _read_video_frames(path, 1, with_colour, first_frame)


def count_frames(path: Path) -> int:
    """Count the images that `read_video` yields; for a video the count is from its metadata, which may be wrong.

    Raises
    ------
    ValueError
        See `read_images`.
    """
    if path.is_dir():
        return len(_list_files(path))
    video = _open_video(path)
    try:
        count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    finally:
        video.release()
    return count if count > 0 else sum(1 for _ in _read_video_frames(path, 1))


def to_named_image(name: str, colour: np.ndarray, time: float) -> NamedImage:
    """Build a named image from a colour image (H, W, 3) uint8 sRGB; its grey image is computed."""
    return NamedImage(name, cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY), time, colour)


def _list_files(folder: Path) -> list[Path]:
    alphabetical = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())
    if not alphabetical:
        raise ValueError(f"{folder}: holds no images. Give a folder of PNG or JPEG images.")
    # A hyphen is a minus sign if the same words also occur before a number without it.
    plain = {before for path in alphabetical for before, _ in _split_name(path)[:-1]}
    files = sorted(alphabetical, key=lambda path: [_apply_sign(each, plain) for each in _split_name(path)])
    if files != alphabetical:
        first = next(index for index, path in enumerate(files) if path != alphabetical[index])
        _warn_once(
            f"{folder}: is read in the order of the numbers in its names, not alphabetically: image {first + 1} is "
            f"{files[first].name}, not {alphabetical[first].name}"
        )
    return files


def _split_name(path: Path) -> list[tuple[str, str]]:
    """Split a file name into pairs of text and the number after it; text at the end has the number -1."""
    *pairs, end = NUMBER_PATTERN.split(f"/{path.stem.casefold()}")
    return [*zip(pairs[::2], pairs[1::2], strict=True), (end, "-1")]


def _apply_sign(name_parts: tuple[str, str], unsigned_names: set[str]) -> tuple[str, int]:
    words, number = name_parts
    if words.endswith("-") and words[:-1] in unsigned_names:
        return words[:-1], -int(number)
    return words, int(number)


@cache
def _warn_once(text: str) -> None:
    """Emit a warning, but each text only once."""
    warnings.warn(text, stacklevel=1)


def _read_image(path: Path, flag: str = "L") -> np.ndarray:
    """Read an image as stored, grey ("L") or "RGB"; EXIF orientation is ignored, as calibrations use stored pixels."""
    if path.stat().st_size > MAX_FILE_BYTES:
        raise ValueError(f"{path}: is larger than {MAX_FILE_BYTES / 1e6:.0f} MB. Remove it, or write it smaller.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path, formats=("PNG", "JPEG")) as picture:
                _check_size(path, *picture.size)
                if picture.mode.startswith("I"):  # 16 bits
                    grey = (np.asarray(picture) >> 8).astype(np.uint8)
                    return grey if flag == "L" else np.repeat(grey[..., None], 3, axis=2)
                return np.asarray(picture.convert(flag))
    except (Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        raise ValueError(f"{path}: {TOO_LARGE_ERROR}") from error
    except (OSError, SyntaxError) as error:
        raise ValueError(f"{path}: is not a readable image. Remove it, or write it again.") from error


def _read_video_frames(path: Path, step: int | None, colour: bool = False, start: int = 0) -> Iterator[NamedImage]:
    """Yield every `step`-th frame of a video from the `start` on; None: a step that gives `MAX_IMAGES` frames."""
    if not path.is_file():
        raise ValueError(f"{path}: no such file. {REMEDY}")
    video = _open_video(path)
    try:
        width, height = (int(video.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if not video.isOpened() or min(width, height) < 1:
            raise ValueError(
                f"{path}: is not a readable video, as {_describe_flaw(path)}: give a video, or a folder of PNG or "
                "JPEG images."
            )
        _check_size(path, width, height)
        if turn := int(video.get(cv2.CAP_PROP_ORIENTATION_META)):
            _warn_once(
                f"{path}: its metadata turns it by {turn} degrees: pixels are used as stored, as by calibrations"
            )
        # The length in a file's metadata may be wrong: frames are read until the end.
        count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        every = step or (-(-count // MAX_IMAGES) if count > 0 else VIDEO_STRIDE)
        number = 0
        while video.grab():
            if number >= start and (number - start) % every == 0:
                time = 1e-3 * video.get(cv2.CAP_PROP_POS_MSEC)
                good, frame = video.retrieve()
                if good and colour:
                    yield to_named_image(f"frame {number}", cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), time)
                elif good:
                    yield NamedImage(f"frame {number}", cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), time)
            number += 1
    finally:
        video.release()


def _open_video(path: Path) -> cv2.VideoCapture:
    """Open a video without console output of FFmpeg and OpenCV; the caller reports errors as exceptions."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read at the first video of a process
    logging = cv2.utils.logging  # type: ignore[attr-defined]
    before = logging.setLogLevel(logging.LOG_LEVEL_ERROR)
    try:
        video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0.0)  # the calibration is for pixels as stored
        return video
    finally:
        logging.setLogLevel(before)


def _describe_flaw(path: Path) -> str:
    """Describe the reason why a file is not a video, from its first bytes."""
    with path.open("rb") as file:
        first = file.read(8)
    if not first:
        return "it is empty"
    return (
        "it is cut off or damaged" if any(each in first for each in VIDEO_SIGNATURES) else "its bytes are not a video's"
    )


def _select_image_numbers(count: int) -> list[int]:
    """Return at most `MAX_IMAGES` integers below `count`, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, min(count, MAX_IMAGES)).round().astype(int)).tolist()


def _check_size(path: Path, width: int, height: int) -> None:
    if max(width, height) > MAX_IMAGE_SIDE or width * height > MAX_PIXELS:
        raise ValueError(f"{path}: {TOO_LARGE_ERROR}")


def read_frame_rate(path: Path) -> float | None:
    """Return the frame rate [1/s] from a video's metadata; None for a folder, or if the video has none."""
    if not path.is_file():
        return None
    video = _open_video(path)
    try:
        rate = float(video.get(cv2.CAP_PROP_FPS))
        return rate if 0.0 < rate < np.inf else None
    finally:
        video.release()
