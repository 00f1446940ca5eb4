"""Synthetic camera images of printed targets, and time stamps in images, for tests with known poses."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np

from ..optics.camera import Camera
from .targets import BORDER_WIDTH, Face, Target, find_window, is_seen_from_front

TEXTURE_PIXELS = 48  # Texture pixels along a square's side.
SAMPLES_PER_SIDE = 4  # Rays along a pixel's side.
FACE_MARGIN = 3.0  # Margin round a face [pixel]: its edges are straight only without a lens.
INK, PAPER = 25.0, 225.0  # Grey levels of black ink and white paper.


def render_targets(image: np.ndarray, camera: Camera, targets: Sequence[tuple[Target, np.ndarray]]) -> np.ndarray:
    """Render targets in front of a background image (H, W) or (H, W, 3) uint8, sharp and evenly lit; return the image.

    Every pixel is the mean of `SAMPLES_PER_SIDE`^2 rays, traced through the lens to the first face on their way.

    Parameters
    ----------
    image
        Background image.
    camera
        Camera with its pose in the world.
    targets
        Targets, each with its pose T_world_target (4, 4) [m].
    """
    own = replace(camera, T_camera_world=np.eye(4))
    placed = [
        (face, camera.T_camera_world @ T_world_target @ face.T_target_face)
        for target, T_world_target in targets
        for face in target.faces
    ]
    windows = [
        (face, T, find_window(own, _sample_edge(face) @ T[:3, :3].T + T[:3, 3], 0.0, FACE_MARGIN)) for face, T in placed
    ]
    seen = [(face, T, where) for face, T, where in windows if where is not None and is_seen_from_front(T)]
    if not seen:
        return image.copy()
    box = tuple(
        slice(min(where[axis].start for *_, where in seen), max(where[axis].stop for *_, where in seen))
        for axis in (0, 1)
    )
    box = tuple(_widen_side(side, size) for side, size in zip(box, (camera.height, camera.width), strict=True))
    straight, inverse = camera.straight[box], np.linalg.inv(camera.K)
    by_row, by_column = (np.gradient(straight, axis=axis) for axis in (0, 1))
    ink, cover = np.zeros(straight.shape[:2]), np.zeros(straight.shape[:2])
    for shift in _compute_sample_offsets():
        nearest, grey = np.full(ink.shape, np.inf), np.zeros(ink.shape)
        for face, T, where in seen:
            part = tuple(slice(a.start - b.start, a.stop - b.start) for a, b in zip(where, box, strict=True))
            pixels = straight[part] + shift[0] * by_column[part] + shift[1] * by_row[part]
            rays = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], axis=-1) @ inverse.T
            depth = (T[:3, 2] @ T[:3, 3]) / (rays @ T[:3, 2])
            here = _sample_grey(face, _draw_face(face), (rays * depth[..., None] - T[:3, 3]) @ T[:3, :2])
            front = ~np.isnan(here) & (depth > 0.0) & (depth < nearest[part])
            grey[part], nearest[part] = np.where(front, here, grey[part]), np.where(front, depth, nearest[part])
        ink, cover = ink + grey, cover + (nearest < np.inf)
    behind = image[box].astype(np.float64)
    share, ink = 1.0 - cover / SAMPLES_PER_SIDE**2, ink / SAMPLES_PER_SIDE**2
    if image.ndim == 3:
        share, ink = share[..., None], ink[..., None]
    out = image.copy()
    out[box] = np.clip(np.rint(share * behind + ink), 0.0, 255.0).astype(np.uint8)
    return out


@lru_cache(maxsize=16)
def _draw_face(face: Face) -> np.ndarray:
    return face.draw(TEXTURE_PIXELS)


def _widen_side(side: slice, size: int) -> slice:
    """Widen a slice to at least two pixels within `size` pixels, as a gradient needs two."""
    start = min(side.start, size - 2)
    return slice(start, max(side.stop, start + 2))


def _compute_sample_offsets() -> np.ndarray:
    """Compute the offsets (n, 2) [pixel] of a pixel's samples from its centre."""
    middles = (np.arange(SAMPLES_PER_SIDE) + 0.5) / SAMPLES_PER_SIDE - 0.5
    return np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)


def _sample_edge(face: Face) -> np.ndarray:
    """Sample points (n, 3) [m] along the outer edge of a face's border, in the face's frame."""
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * (0.5 * face.size + BORDER_WIDTH)
    edge = np.concatenate([np.linspace(a, b, 9) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    return np.column_stack([edge + 0.5 * face.size, np.zeros(len(edge))])


def _sample_grey(face: Face, printed: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Sample grey levels (...) at positions (..., 2) [m] on the `printed` image of a face; NaN outside its border."""
    pixels = (positions * (TEXTURE_PIXELS / face.square) - 0.5).astype(np.float32)
    paper = cv2.remap(
        printed, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=255.0
    )
    (x, y), (width, height) = np.moveaxis(positions, -1, 0), face.size + BORDER_WIDTH
    inside = (x >= -BORDER_WIDTH) & (x <= width) & (y >= -BORDER_WIDTH) & (y <= height)
    return np.where(inside, INK + (PAPER - INK) / 255.0 * paper, np.nan)


CELL_SIDE = 8  # Side of a cell [pixel].
CELL_BORDER = 2  # Border of a cell that is not read [pixel].
START_CELLS = (1, 0, 1, 0)  # Cells that begin every strip (1: white).
TIME_BITS = 32  # Number of bits of the time.
TIME_UNIT = 1e-4  # Unit of the time [s].
CHECK_BITS = 8  # Number of bits of the time's checksum.
CELL_COUNT = len(START_CELLS) + TIME_BITS + CHECK_BITS  # Number of cells of a strip.
STRIP_WIDTH = CELL_SIDE * CELL_COUNT
"""Width of a time stamp's strip of cells [pixel]."""
MAX_BLACK, MIN_WHITE = 90.0, 165.0  # Grey levels below which a cell is black, and above which it is white.


def stamp_time(image: np.ndarray, time: float) -> np.ndarray:
    """Return a copy of an image (H, W, 3) or (H, W) uint8 with a time stamp [s] in its upper right corner.

    Raises
    ------
    ValueError
        The time is negative or longer than five days, or the image is too small.
    """
    count = round(time / TIME_UNIT) if np.isfinite(time) else -1
    if not 0 <= count < 2**TIME_BITS:
        raise ValueError(f"the time stamp {time:g} s is out of range: give 0 to {2**TIME_BITS * TIME_UNIT:g} s.")
    if image.shape[0] < CELL_SIDE or image.shape[1] < STRIP_WIDTH:
        raise ValueError(
            f"a time needs {STRIP_WIDTH} x {CELL_SIDE} pixels: the image has {image.shape[1]} x {image.shape[0]}."
        )
    bits = [*START_CELLS, *_to_bits(count, TIME_BITS), *_to_bits(_check(count), CHECK_BITS)]
    strip = np.kron(np.array(bits, np.uint8), np.ones((CELL_SIDE, CELL_SIDE), np.uint8)) * 255
    out = image.copy()
    out[:CELL_SIDE, -STRIP_WIDTH:] = strip if image.ndim == 2 else strip[..., None]
    return out


def read_time_stamp(grey: np.ndarray) -> float | None:
    """Read the time stamp [s] in the upper right corner of an image (H, W) uint8; None if missing or damaged."""
    if grey.shape[0] < CELL_SIDE or grey.shape[1] < STRIP_WIDTH:
        return None
    cells = grey[CELL_BORDER : CELL_SIDE - CELL_BORDER, -STRIP_WIDTH:].reshape(
        CELL_SIDE - 2 * CELL_BORDER, CELL_COUNT, CELL_SIDE
    )[..., CELL_BORDER : CELL_SIDE - CELL_BORDER]
    means = cells.mean(axis=(0, 2))
    if ((means > MAX_BLACK) & (means < MIN_WHITE)).any():
        return None
    bits = (means >= MIN_WHITE).astype(int).tolist()
    count = _from_bits(bits[len(START_CELLS) : len(START_CELLS) + TIME_BITS])
    sound = tuple(bits[: len(START_CELLS)]) == START_CELLS and _from_bits(bits[-CHECK_BITS:]) == _check(count)
    return count * TIME_UNIT if sound else None


def _to_bits(number: int, count: int) -> list[int]:
    return [(number >> place) & 1 for place in reversed(range(count))]


def _from_bits(bits: list[int]) -> int:
    return sum(bit << place for place, bit in enumerate(reversed(bits)))


def _check(count: int) -> int:
    """Compute an 8-bit checksum of a time: bytes are weighted by different odd numbers, which detects swapped bytes."""
    return (0xA5 + sum((2 * k + 3) * byte for k, byte in enumerate(count.to_bytes(TIME_BITS // 8, "big")))) % 256
