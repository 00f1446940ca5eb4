"""Rows of one episode's arrays: pictures decoded, and NaN where nothing was solved."""

from __future__ import annotations

import h5py
import numpy as np

from ar.picture_bytes import decoded_colour, decoded_depth, decoded_labels
from sim.errors import InputError
from sim.runtime.outside_files import read_as

from .contents import Contents, array_in
from .open_files import REMEDY
from .schema import ARRAYS, COLOUR, DEPTH, PICTURES, SOLVED

Rows = np.ndarray | list[str]


def rows_of(file: h5py.File, contents: Contents, name: str, frames: range | None = None) -> Rows:
    """The rows of some frames, or of all: (frames, ...) numbers or decoded pictures, or a list of texts.

    An array without frames is read whole.

    Colour is (frames, H, W, 3) uint8 sRGB, depth (frames, H, W) float32 [m], labels (frames, H, W) uint8. What finite
    elements did not solve is NaN, or an empty text.

    Raises
    ------
    InputError
        A picture that cannot be decoded, or is of another size than the file says; a file that is damaged.
    """
    frames = range(contents.frames) if frames is None else frames
    if name in PICTURES:
        return np.stack([picture_of(file, contents, name, frame) for frame in frames])
    with read_as(contents.path, "an episode", REMEDY):
        array = array_in(file, name)
        if ARRAYS[name].axes[0] == SOLVED and name != "fem_frames":
            return _solved(array, contents, frames)
        return _read(array, frames) if ARRAYS[name].framed else array[:]


def numbers_in(file: h5py.File, contents: Contents, name: str, frames: range | None = None) -> np.ndarray:
    """As `rows_of`, of an array that holds no texts."""
    return np.asarray(rows_of(file, contents, name, frames))


def picture_of(file: h5py.File, contents: Contents, name: str, frame: int) -> np.ndarray:
    """One picture, decoded.

    Raises
    ------
    InputError
        As `rows_of`.
    """
    code = code_of(file, contents, name, frame)
    width, height = contents.size
    try:
        if PICTURES[name] == COLOUR:
            return decoded_colour(code, width, height)
        if PICTURES[name] == DEPTH:
            return decoded_depth(code, width, height, contents.depth_scale)
        return decoded_labels(code, width, height)
    except ValueError as error:
        raise InputError(
            f"{contents.path}: the picture {name!r} of frame {frame} cannot be decoded: {error}. Make the episode anew."
        ) from error


def code_of(file: h5py.File, contents: Contents, name: str, frame: int) -> bytes:
    """The bytes of one picture as they are stored; InputError of a file that is damaged."""
    with read_as(contents.path, "an episode", REMEDY):
        return np.asarray(array_in(file, f"pictures/{name}")[frame], np.uint8).tobytes()


def _read(array: h5py.Dataset, frames: range) -> Rows:
    found = array[frames.start : frames.stop : frames.step]
    if array.dtype.kind != "O":
        return found
    return [text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text) for text in found]


def _solved(array: h5py.Dataset, contents: Contents, frames: range) -> Rows:
    """Rows of an array that has one for each frame that was solved."""
    if len(contents.fem_frames) == contents.frames:
        return _read(array, frames)
    wanted = np.arange(frames.start, frames.stop, frames.step)
    known = np.isin(wanted, contents.fem_frames)
    places = np.searchsorted(contents.fem_frames, wanted[known])
    rows = _read(array, range(places[0], places[-1] + 1)) if len(places) else array[:0]
    if isinstance(rows, list):
        texts = dict(zip(wanted[known].tolist(), (rows[place - places[0]] for place in places), strict=True))
        return [texts.get(frame, "") for frame in wanted.tolist()]
    if array.dtype.kind == "O":
        return [""] * len(wanted)
    found = np.full((len(wanted), *array.shape[1:]), np.nan, array.dtype)
    found[known] = rows[places - places[0]] if len(places) else rows
    return found
