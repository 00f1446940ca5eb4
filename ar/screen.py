"""Image files (PNG, folder of frames, video), and decoding of image bytes from untrusted sources."""

import struct
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np


class FrameFolder:
    """Folder that receives frames as `frame_0000.png`, `frame_0001.png`, ...; each file is written atomically."""

    def __init__(self, folder: Path) -> None:
        """Create the folder if it is missing; ValueError if the path is a file."""
        self.folder = Path(folder)
        if self.folder.exists() and not self.folder.is_dir():
            raise ValueError(f"{self.folder} is a file: name a folder for the frames.")
        self.folder.mkdir(parents=True, exist_ok=True)

    def show(self, number: int, colour: np.ndarray) -> None:
        """Write the image `colour` (H, W, 3) uint8 sRGB of frame `number` as a PNG file."""
        write_png(self.folder / f"frame_{number:04d}.png", colour)


def write_png(path: Path, colour: np.ndarray) -> None:
    """Write an image (H, W, 3) uint8 sRGB as a PNG file, atomically; a missing folder is created.

    Raises OSError if the file cannot be written.
    """
    part = path.with_name(f".{path.name}.part")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        part.write_bytes(cv2.imencode(".png", colour[..., ::-1])[1].tobytes())
        part.rename(path)
    finally:
        part.unlink(missing_ok=True)


def shrink_image(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Downsample an image (H, W, 3) uint8 to (height, width, 3), by the mean of the pixels under each new pixel."""
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def read_png(path: Path) -> np.ndarray:
    """Read an image file as (H, W, 3) uint8 sRGB; ValueError if it is not a readable image."""
    bgr = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if bgr is None:
        raise ValueError(f"{path} is not a readable image.")
    return np.ascontiguousarray(bgr[..., ::-1])


def write_movie(path: Path, images: Iterable[np.ndarray], frames_per_second: float = 25.0) -> None:
    """Write images (H, W, 3) uint8 sRGB of equal size as a video: `.mp4`, or a looping `.gif` or `.webp`.

    The file is written atomically. If reading `images` or writing fails, nothing is written.

    Raises
    ------
    ValueError
        The suffix is unknown, the rate is not positive, there is no image, or image sizes differ.
    OSError
        The file cannot be written.
    """
    path = Path(path)
    writers = {".mp4": write_video, ".gif": write_animation, ".webp": write_animation}
    if path.suffix not in writers:
        raise ValueError(f"{path} ends in {path.suffix!r}: videos are {', '.join(writers)}.")
    if not frames_per_second > 0.0:
        raise ValueError(f"{frames_per_second} frames per second: give a positive rate.")
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        writers[path.suffix](part, images, frames_per_second)
        part.rename(path)
    finally:
        part.unlink(missing_ok=True)


def write_video(path: Path, images: Iterable[np.ndarray], frames_per_second: float) -> None:
    """Write an MPEG-4 part 2 video image by image, so that only one image is in memory."""
    writer, size = None, None
    for colour in images:
        if writer is None:
            size = colour.shape
            code = cv2.VideoWriter.fourcc(*"mp4v")
            writer = cv2.VideoWriter(str(path), code, frames_per_second, (size[1], size[0]))
            if not writer.isOpened():
                raise OSError(f"{path.parent} cannot hold the video: check that the folder exists and is writable.")
        check_size(colour, size)
        writer.write(np.ascontiguousarray(colour[..., ::-1]))
    if writer is None:
        raise ValueError("a video needs at least one image.")
    writer.release()


def write_animation(path: Path, images: Iterable[np.ndarray], frames_per_second: float) -> None:
    """Write a GIF or WebP animation that loops forever; all images are in memory at once."""
    frames = [np.ascontiguousarray(colour[..., ::-1]) for colour in images]
    if not frames:
        raise ValueError("a video needs at least one image.")
    for frame in frames:
        check_size(frame, frames[0].shape)
    animation = cv2.Animation()
    animation.frames = frames
    animation.durations = [round(1e3 / frames_per_second)] * len(frames)
    quality = [cv2.IMWRITE_WEBP_QUALITY, 80] if path.suffix == ".webp" else []
    if not cv2.imwriteanimation(str(path), animation, quality):
        raise OSError(f"{path.parent} cannot hold the video: check that the folder exists and is writable.")


def check_size(image: np.ndarray, size: tuple[int, ...] | None) -> None:
    """Raise ValueError if an image does not have the shape `size` of the first image."""
    if image.shape != size:
        raise ValueError(f"images of {size} and {image.shape}: all images of a video must have one size.")


PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"  # First bytes of a PNG and of a JPEG.
PNG_END, JPEG_END = b"IEND\xaeB`\x82", b"\xff\xd9"  # Last bytes of a PNG and of a JPEG.
# Markers of a JPEG's frame header, which holds its size; the markers of coding tables in that range are excluded.
SIZE_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
IGNORE_ORIENTATION = cv2.IMREAD_IGNORE_ORIENTATION
"""OpenCV flag to ignore EXIF orientation, because camera matrices are for unrotated images."""


def read_image_size(data: bytes) -> tuple[int, int]:
    """Read width and height [pixel] from the header of a JPEG or a PNG, without decoding.

    Raises
    ------
    ValueError
        The bytes are neither a JPEG nor a PNG, or they are truncated or damaged.
    """
    ending = PNG_END if data.startswith(PNG) else JPEG_END if data.startswith(JPEG) else None
    if ending is None:
        raise ValueError("it is neither a JPEG nor a PNG")
    if not data.endswith(ending):
        raise ValueError("it ends too early")
    try:
        if ending is PNG_END:
            width, height = struct.unpack_from(">II", data, 16)
            return width, height
        place = 2
        while True:
            mark, kind, length = struct.unpack_from(">BBH", data, place)
            if mark != 0xFF or length < 2:
                raise ValueError("its header is damaged")
            if kind in SIZE_MARKERS:
                height, width = struct.unpack_from(">HH", data, place + 5)
                return width, height
            place += 2 + length
    except struct.error as error:
        raise ValueError("its header is damaged") from error


def decode_colour(data: bytes, width: int, height: int) -> np.ndarray:
    """Decode a JPEG or PNG to an image (height, width, 3) uint8 sRGB.

    Raises
    ------
    ValueError
        The bytes are not such an image, or the image has another size or type.
    """
    return _decode_image(data, (height, width, 3), cv2.IMREAD_COLOR_RGB | IGNORE_ORIENTATION, np.uint8)


def decode_depth(data: bytes, width: int, height: int, scale: float) -> np.ndarray:
    """Decode depth (height, width) float32 [m] from a 16-bit PNG with unit `scale` [m]; 0 means no surface.

    Raises
    ------
    ValueError
        See `decode_colour`.
    """
    steps = _decode_image(data, (height, width), cv2.IMREAD_UNCHANGED | IGNORE_ORIENTATION, np.uint16)
    return steps * np.float32(scale)


def decode_labels(data: bytes, width: int, height: int) -> np.ndarray:
    """Decode labels (height, width) uint8 from an 8-bit PNG.

    Raises
    ------
    ValueError
        See `decode_colour`.
    """
    return _decode_image(data, (height, width), cv2.IMREAD_UNCHANGED | IGNORE_ORIENTATION, np.uint8)


def _decode_image(code: bytes, shape: tuple[int, ...], flag: int, dtype: type) -> np.ndarray:
    width, height = read_image_size(code)
    if (height, width) != shape[:2]:
        raise ValueError(f"it has {width} x {height} pixels in place of {shape[1]} x {shape[0]}")
    try:
        picture = cv2.imdecode(np.frombuffer(code, np.uint8), flag)
    except cv2.error as error:
        raise ValueError("it is damaged") from error
    if picture is None:
        raise ValueError("it is damaged")
    if picture.shape != shape or picture.dtype != dtype:
        channels = 1 if picture.ndim == 2 else picture.shape[2]
        raise ValueError(f"it has {channels} channels of {8 * picture.dtype.itemsize} bits")
    return picture
