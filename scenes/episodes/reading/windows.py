"""Reading of decoded array rows of one episode, and of windows of frames from many episodes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ar.screen import decode_colour, decode_depth, decode_labels
from sim.errors import InputError
from sim.runtime.outside_files import to_path, wrap_errors

from .contents import REMEDY, EpisodeContents, FileCache, get_array, read_contents
from .schema import ARRAYS, COLOUR, DEPTH, PICTURES, SOLVED

Rows = np.ndarray | list[str]


def read_rows(file: h5py.File, contents: EpisodeContents, name: str, frames: range | None = None) -> Rows:
    """Read the rows of some `frames` (None: all) of an array: numbers or decoded images (frames, ...), or texts.

    An array without a frame axis is read completely.

    Colour is (frames, H, W, 3) uint8 sRGB, depth (frames, H, W) float32 [m], labels (frames, H, W) uint8. Frames
    that are not solved by FEM have NaN, or an empty text.

    Raises
    ------
    InputError
        An image cannot be decoded or has a wrong size, or the file is damaged.
    """
    frames = range(contents.frames) if frames is None else frames
    if name in PICTURES:
        return np.stack([read_one_image(file, contents, name, frame) for frame in frames])
    with wrap_errors(contents.path, "an episode", REMEDY):
        array = get_array(file, name)
        if ARRAYS[name].axes[0] == SOLVED and name != "fem_frames":
            return _read_solved_rows(array, contents, frames)
        return _read_frames(array, frames) if ARRAYS[name].has_frame_axis else array[:]


def read_numbers(file: h5py.File, contents: EpisodeContents, name: str, frames: range | None = None) -> np.ndarray:
    """Read the rows of an array without texts as a NumPy array; see `read_rows`."""
    return np.asarray(read_rows(file, contents, name, frames))


def read_one_image(file: h5py.File, contents: EpisodeContents, name: str, frame: int) -> np.ndarray:
    """Read and decode the image `name` of one frame.

    Raises
    ------
    InputError
        See `read_rows`.
    """
    code = read_image_bytes(file, contents, name, frame)
    width, height = contents.size
    try:
        if PICTURES[name] == COLOUR:
            return decode_colour(code, width, height)
        if PICTURES[name] == DEPTH:
            return decode_depth(code, width, height, contents.depth_scale)
        return decode_labels(code, width, height)
    except ValueError as error:
        raise InputError(
            f"{contents.path}: the image {name!r} of frame {frame} cannot be decoded: {error}. Make the episode again."
        ) from error


def read_image_bytes(file: h5py.File, contents: EpisodeContents, name: str, frame: int) -> bytes:
    """Read the encoded bytes of one image; raise InputError if the file is damaged."""
    with wrap_errors(contents.path, "an episode", REMEDY):
        return np.asarray(get_array(file, f"pictures/{name}")[frame], np.uint8).tobytes()


def _read_frames(array: h5py.Dataset, frames: range) -> Rows:
    found = array[frames.start : frames.stop : frames.step]
    if array.dtype.kind != "O":
        return found
    return [text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text) for text in found]


def _read_solved_rows(array: h5py.Dataset, contents: EpisodeContents, frames: range) -> Rows:
    """Read the rows of `frames` from an array with a row per solved frame; other rows are NaN or an empty text."""
    if len(contents.fem_frames) == contents.frames:
        return _read_frames(array, frames)
    wanted = np.arange(frames.start, frames.stop, frames.step)
    known = np.isin(wanted, contents.fem_frames)
    places = np.searchsorted(contents.fem_frames, wanted[known])
    rows = _read_frames(array, range(places[0], places[-1] + 1)) if len(places) else array[:0]
    if isinstance(rows, list):
        texts = dict(zip(wanted[known].tolist(), (rows[place - places[0]] for place in places), strict=True))
        return [texts.get(frame, "") for frame in wanted.tolist()]
    if array.dtype.kind == "O":
        return [""] * len(wanted)
    found = np.full((len(wanted), *array.shape[1:]), np.nan, array.dtype)
    found[known] = rows[places - places[0]] if len(places) else rows
    return found


FEM_KNOWN = "fem_known"
"""Key of the mask (T,) bool of frames that FEM solved, which accompanies FEM arrays."""


def list_episode_paths(locations: str | Path | Sequence[str | Path]) -> list[Path]:
    """List the files of episodes: given files, and sorted files in given folders or their subfolders `episodes`.

    Raises
    ------
    InputError
        A path is missing, or a folder has no episodes.
    """
    paths: list[Path] = []
    for one in [locations] if isinstance(locations, str | Path) else locations:
        place = to_path(one)
        if not place.is_dir():
            paths.append(place)
            continue
        inside = place / "episodes" if (place / "episodes").is_dir() else place
        found = sorted(path for path in inside.glob("*.h5") if not path.name.startswith("."))
        if not found:
            raise InputError(f"{place}: holds no episodes (.h5). Name a folder of them, or the files.")
        paths += found
    if not paths:
        raise InputError("no episodes: name a folder of them, or the files.")
    missing = next((path for path in paths if not path.is_file()), None)
    if missing is not None:
        raise InputError(f"{missing}: no such file. Name an episode, .h5, or a folder of them.")
    return paths


@dataclass(frozen=True, eq=False)
class Episodes(Sequence[dict[str, Any]]):
    """Sequence of windows of T frames; a window is a dict of arrays (T, ...) or values of the episode, by key.

    Images are decoded: colour (T, H, W, 3) uint8, depth (T, H, W) float32 [m], segmentation (T, H, W) uint8. Rows of
    FEM arrays are NaN for frames that FEM did not solve; `fem_known` (T,) marks solved frames. The keys `episode` and
    `frame` (T,) are always present. Each process opens its own files at their first use.

    Parameters
    ----------
    contents
        Contents of each episode, as `read_episodes` reads them.
    keys
        Arrays and images to read.
    window, step, stride
        Number of frames of a window, step between its frames, and step between starts of windows [frames].
    files
        Cache of open files.
    """

    contents: tuple[EpisodeContents, ...]
    keys: tuple[str, ...]
    window: int = 1
    step: int = 1
    stride: int = 1
    files: FileCache = field(default_factory=FileCache)

    def __post_init__(self) -> None:
        for name in ("window", "step", "stride"):
            if not isinstance(value := getattr(self, name), int) or value < 1:
                raise InputError(f"{name} {value!r}: give a whole number of frames, 1 or more.")
        for name in self.keys:
            without = next((one for one in self.contents if name not in one.shapes), None)
            if without is not None:
                raise InputError(f"{without.path}: has no {name!r}. It has {', '.join(sorted(without.shapes))}.")

    @property
    def span(self) -> int:
        """Number of frames from the first to the last frame of a window, including both."""
        return (self.window - 1) * self.step + 1

    @cached_property
    def ends(self) -> list[int]:
        """Cumulative number of windows at the end of each episode."""
        counts = (
            (one.frames - self.span) // self.stride + 1 if one.frames >= self.span else 0 for one in self.contents
        )
        return list(accumulate(counts))

    def __len__(self) -> int:
        return self.ends[-1]

    def __getitem__(self, index: int) -> dict[str, Any]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return window `index`, counted over all episodes; raise IndexError beyond the last window."""
        episode, first = self.place(index)
        return self.get_window(episode, first)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return (self[index] for index in range(len(self)))

    def place(self, index: int) -> tuple[int, int]:
        """Return the episode number and the first frame of window `index`; raise IndexError beyond the last window."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"window {index} of {len(self)}")
        index %= len(self)
        episode = int(np.searchsorted(self.ends, index, "right"))
        return episode, (index - (self.ends[episode - 1] if episode else 0)) * self.stride

    def get_window(self, episode: int, first: int) -> dict[str, Any]:
        """Return the window that begins at frame `first` of an episode.

        Raises
        ------
        InputError
            The episode has no such window, the file is damaged, or an image cannot be decoded.
        """
        contents = self.contents[episode]
        if not 0 <= first <= contents.frames - self.span:
            raise InputError(f"{contents.path}: no {self.span} of its {contents.frames} frames begin at {first}.")
        frames = range(first, first + self.span, self.step)
        file = self.files.get_file(contents.path)
        found: dict[str, Any] = {name: read_rows(file, contents, name, frames) for name in self.keys}
        if any(name in ARRAYS and ARRAYS[name].axes[0] == SOLVED for name in self.keys):
            found[FEM_KNOWN] = np.isin(np.asarray(frames), contents.fem_frames)
        return {**found, "episode": episode, "frame": np.asarray(frames)}

    def iterate_batches(self, size: int, seed: int | None = None) -> Iterator[dict[str, Any]]:
        """Yield batches of `size` stacked windows (the last may be smaller); shuffled if a `seed` is given.

        Raises
        ------
        InputError
            See `get_window`; the size is < 1, or rows have different shapes (for example tumours of two bodies).
        """
        if size < 1:
            raise InputError(f"batches of {size}: give a whole number of windows, 1 or more.")
        order = np.arange(len(self)) if seed is None else np.random.default_rng(seed).permutation(len(self))
        for start in range(0, len(order), size):
            windows = [self[int(index)] for index in order[start : start + size]]
            yield {name: _stack_rows(name, [one[name] for one in windows]) for name in windows[0]}

    at, batches = get_window, iterate_batches  # Former names, for one release.


def read_episodes(
    paths: str | Path | Sequence[str | Path],
    keys: Sequence[str] | None = None,
    window: int = 1,
    step: int = 1,
    stride: int = 1,
    most_open: int = 16,
) -> Episodes:
    """Read windows of frames from the episodes in a folder or in files.

    Parameters
    ----------
    keys
        Names of arrays and images; None: all numbers and images that every episode has.
    window, step, stride
        See `Episodes`.
    most_open
        Maximum number of open files in a process.

    Raises
    ------
    InputError
        See `list_episode_paths`, `read_contents` and `Episodes`.
    """
    contents = tuple(read_contents(path) for path in list_episode_paths(paths))
    if keys is None:
        common = set.intersection(*(set(one.shapes) for one in contents)) - {"fem_frames"}
        keys = sorted(name for name in common if name in PICTURES or ARRAYS[name].kind != "O")
    return Episodes(contents, tuple(keys), window, step, stride, FileCache(most_open))


def _stack_rows(name: str, rows: list[Any]) -> Rows | list[Any]:
    if isinstance(rows[0], list):
        return rows
    try:
        return np.stack(rows)
    except ValueError as error:
        shapes = sorted({np.shape(one) for one in rows})
        raise InputError(
            f"{name!r} has shapes {shapes[0]} and {shapes[-1]}: leave it out, or take batches of 1."
        ) from error
