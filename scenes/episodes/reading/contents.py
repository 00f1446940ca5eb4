"""Contents of episode files, which are checked before use, and a cache with a limited number of open files."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sim.errors import InputError
from sim.runtime.file_limits import MAX_ARRAY_BYTES, MAX_INFLATION
from sim.runtime.outside_files import to_path, wrap_errors

from .schema import ARRAYS, FORMATS, FRAMES, PICTURES, REQUIRED_ARRAYS, SOLVED, ArraySpec

HINT = "`sulcus validate` gives details; "  # Hint in error messages.
REMEDY = f"{HINT}make it again, or leave it out."  # Remedy in error messages.


def open_episode(path: Path) -> h5py.File:
    """Open the file of an episode; raise InputError if the file is missing or not HDF5."""
    with wrap_errors(path, "an episode", REMEDY):
        return h5py.File(path, "r")


def format_finding(error: InputError, path: Path) -> str:
    """Format an error about an episode as a finding, without the path and without the hint to `sulcus validate`."""
    return str(error).removeprefix(f"{path}: ").replace(f"{HINT}make", "Make")


class FileCache:
    """Cache of open files. A file is opened at its first use; at the limit, the least recently used file is closed.

    Forked processes and processes that unpickle this object open their own files.
    """

    def __init__(self, max_files: int = 16) -> None:
        if max_files < 1:
            raise InputError(f"{max_files} open files: at least one must be.")
        self.most = max_files
        self._process = os.getpid()
        self._open: OrderedDict[Path, h5py.File] = OrderedDict()

    def __reduce__(self) -> tuple[type[FileCache], tuple[int]]:
        return FileCache, (self.most,)

    def __len__(self) -> int:
        return len(self._open)

    def get_file(self, path: Path) -> h5py.File:
        """Return the open file of a path.

        Raises
        ------
        InputError
            The file is missing or not HDF5.
        """
        if self._process != os.getpid():
            self.close()
            self._process = os.getpid()
        if path not in self._open:
            while len(self._open) >= self.most:
                self._open.popitem(last=False)[1].close()
            self._open[path] = open_episode(path)
        self._open.move_to_end(path)
        return self._open[path]

    def close(self) -> None:
        """Close all files."""
        while self._open:
            self._open.popitem()[1].close()


MAX_DEPTH = 3  # Maximum depth of nested groups: an episode has one group, `pictures`.
MAX_NAMES = 500  # Maximum number of names in a group.
MAX_FRAMES = 1_000_000  # Maximum number of frames of an episode: hours.
MAX_IMAGE_SIDE = 16384  # Largest image side [pixel].
MAX_TEXT_BYTES = 1 << 20  # Maximum size of a text attribute [bytes]: a plan, or the sampled values.
ALLOWED_FILTERS = {
    h5py.h5z.FILTER_DEFLATE,
    h5py.h5z.FILTER_SHUFFLE,
    h5py.h5z.FILTER_FLETCHER32,
}  # Allowed HDF5 filters.


@dataclass(frozen=True, eq=False)
class EpisodeContents:
    """Contents of one episode, as described by its file.

    Parameters
    ----------
    path
        Path of the file.
    attributes
        Attributes of the file, as texts, numbers and lists.
    shapes
        Shapes of all known arrays, by name; names of images are without the name of their group.
    fem_frames
        Sorted numbers (F,) of the frames that FEM solved.
    """

    path: Path
    attributes: Mapping[str, Any]
    shapes: Mapping[str, tuple[int, ...]]
    fem_frames: np.ndarray

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.shapes["time"][0]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the images [pixel]."""
        return int(self.attributes["width"]), int(self.attributes["height"])

    @property
    def family(self) -> str:
        """Name of the episode's family; without a family, name of its scene."""
        return str(self.attributes.get("family", self.attributes.get("scene", "episode")))

    @property
    def depth_scale(self) -> float:
        """Resolution of the depth images [m]; NaN if not recorded."""
        return float(self.attributes.get("depth_scale_m", np.nan))


def read_contents(path: str | Path) -> EpisodeContents:
    """Read and check the contents of an episode file.

    Raises
    ------
    InputError
        The file is missing or not an episode, contains links to other files, or has arrays of unexpected shape or type
        or larger than the file.
    """
    path = to_path(path)
    with wrap_errors(path, "an episode", REMEDY), h5py.File(path, "r") as file:
        return inspect_contents(file, path)


def inspect_contents(file: h5py.File, path: Path) -> EpisodeContents:
    """Read and check the contents of an open file.

    Raises
    ------
    InputError
        See `read_contents`.
    """
    said = read_attributes(file)
    if said.get("format") not in FORMATS:
        raise InputError(f"it is no episode, but {said.get('format', 'HDF5')!r}. Give files of `sulcus collect`.")
    arrays = dict(_find_arrays(file))
    missing = [name for name in REQUIRED_ARRAYS if name not in arrays]
    missing += [name for name in ("width", "height") if not isinstance(said.get(name), int)]
    if missing:
        raise InputError(f"it has no {missing[0]!r}. {REMEDY}")
    if not all(0 < int(said[name]) <= MAX_IMAGE_SIDE for name in ("width", "height")):
        raise InputError(f"its images have {said['width']} x {said['height']} pixels. {REMEDY}")
    shapes = _check_shapes(arrays)
    return EpisodeContents(path, said, shapes, _read_solved_frames(arrays, shapes))


def read_attributes(item: h5py.Group | h5py.Dataset) -> dict[str, Any]:
    """Read attributes as Python texts, numbers and lists, by name.

    Raises
    ------
    InputError
        An attribute is larger than `MAX_TEXT_BYTES`.
    """
    found = {}
    for name in item.attrs:
        described = item.attrs.get_id(name)
        large = described.dtype.itemsize * int(np.prod(described.shape or (1,))) > MAX_TEXT_BYTES
        value = None if large else item.attrs[name]
        if value is None or (isinstance(value, str | bytes) and len(value) > MAX_TEXT_BYTES):
            raise InputError(f"its attribute {name!r} has more than {MAX_TEXT_BYTES} bytes. {REMEDY}")
        found[name] = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    return found


def get_array(group: h5py.Group, name: str) -> h5py.Dataset:
    """Return an array by name; raise InputError if the item is not an array."""
    found = group[name]
    if not isinstance(found, h5py.Dataset):
        raise InputError(f"{name!r} is no array. {REMEDY}")
    return found


def _find_arrays(file: h5py.Group, prefix: str = "", depth: int = 0) -> Iterator[tuple[str, h5py.Dataset]]:
    """Yield the names and arrays of a file; raise InputError for links and for data in other files."""
    if len(file) > MAX_NAMES or depth > MAX_DEPTH:
        raise InputError(f"it holds more groups or names than an episode has. {REMEDY}")
    for name in file:
        full = f"{prefix}{name}"
        if not isinstance(file.get(name, getlink=True), h5py.HardLink):
            raise InputError(f"{full!r} is a link and no array: episodes with links are not read. {REMEDY}")
        item = file[name]
        if isinstance(item, h5py.Group):
            yield from _find_arrays(item, f"{full}/", depth + 1)
        elif isinstance(item, h5py.Dataset):
            _check_stored_inside(full, item)
            yield full, item


def _check_stored_inside(name: str, array: h5py.Dataset) -> None:
    """Raise InputError if the data of an array are in another file, are missing, or use an unsupported filter."""
    if array.external or array.is_virtual:
        raise InputError(f"{name!r} lies in another file: episodes that refer to others are not read. {REMEDY}")
    pipeline = array.id.get_create_plist()
    filters = {pipeline.get_filter(number)[0] for number in range(pipeline.get_nfilters())}
    if not filters <= ALLOWED_FILTERS:
        raise InputError(f"{name!r} is packed in a way that is not read. {REMEDY}")
    size = array.size or 0
    stored = array.id.get_storage_size()
    if size * array.dtype.itemsize > min(MAX_ARRAY_BYTES, MAX_INFLATION * max(stored, 1 << 10)):
        raise InputError(f"{name!r} of shape {array.shape} is larger than its file can hold. {REMEDY}")


def _check_shapes(arrays: Mapping[str, h5py.Dataset]) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the known arrays, by name; raise InputError if shapes or types are inconsistent."""
    sizes: dict[str, int] = {}
    if "fem_frames" not in arrays:
        sizes[SOLVED] = arrays["time"].shape[0] if arrays["time"].ndim else 0
    shapes = {}
    for name in ("time", "fem_frames", *arrays):
        if name not in arrays:
            continue
        inside, _, last = name.rpartition("/")
        picture = inside == "pictures" and last in PICTURES
        wanted = ArraySpec((FRAMES,), "O") if picture else ARRAYS.get(name)
        if wanted is None:
            continue
        array = arrays[name]
        if array.dtype.kind not in wanted.kind or (picture and h5py.check_vlen_dtype(array.dtype) != np.uint8):
            raise InputError(f"{name!r} holds {array.dtype}: another kind is needed. {REMEDY}")
        _check_shape(name, array.shape, wanted, sizes)
        shapes[last if picture else name] = array.shape
    if not 0 < sizes[FRAMES] <= MAX_FRAMES:
        raise InputError(f"it has {sizes[FRAMES]} frames: 1 to {MAX_FRAMES} are read. {REMEDY}")
    return shapes


def _check_shape(name: str, shape: tuple[int, ...], spec: ArraySpec, sizes: dict[str, int]) -> None:
    """Raise InputError if a shape contradicts known axis lengths in `sizes`; add new axis lengths to `sizes`."""
    axes = spec.axes
    if axes[-1] is None:
        axes = (*axes[:-1], *shape[len(axes) - 1 :])
    needed = tuple(axis if isinstance(axis, int) else sizes.get(str(axis)) for axis in axes)
    if len(shape) != len(needed) or any(one not in (None, other) for one, other in zip(needed, shape, strict=True)):
        said = ", ".join(str(axis) if one is None else str(one) for axis, one in zip(axes, needed, strict=True))
        raise InputError(f"{name!r} has shape {shape} in place of ({said}). {REMEDY}")
    sizes |= {axis: length for axis, length in zip(axes, shape, strict=True) if isinstance(axis, str)}


def _read_solved_frames(arrays: Mapping[str, h5py.Dataset], shapes: Mapping[str, tuple[int, ...]]) -> np.ndarray:
    count = shapes["time"][0]
    if "fem_frames" not in shapes:
        known = any(name in shapes for name in ("tumour_fem", "outcome_fem"))
        return np.arange(count if known else 0)
    frames = np.asarray(arrays["fem_frames"][:], np.int64)
    if len(frames) and (frames[0] < 0 or frames[-1] >= count or (np.diff(frames) < 1).any()):
        raise InputError(f"'fem_frames' are not sorted numbers of its {count} frames. {REMEDY}")
    return frames
