"""Episodes as a LeRobot data set, v3.0: Parquet tables with the encoded images, and JSON.

Images are features of the type `image` with unchanged bytes: JPEG, and PNG of 8 or 16 bits, so that depth is exact.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from sim.errors import InputError
from sim.runtime.atomic_files import write_folder_atomically

from ..reading.contents import EpisodeContents, open_episode
from ..reading.schema import COLOUR, DEPTH, PICTURES, get_suffix
from ..reading.windows import read_image_bytes, read_one_image
from .columns import (
    SPACE,
    collect_numbers,
    compute_frame_rate,
    describe_task,
    list_shared_images,
    list_shared_numbers,
    measure_stored_size,
    name_axes,
    split_into_blocks,
    write_notices,
)


@dataclass(frozen=True, eq=False)
class RowStatistics:
    """Statistics of `count` rows, as float64 arrays with the shape of one row; NaN values are excluded."""

    minimum: np.ndarray
    maximum: np.ndarray
    total: np.ndarray
    squares: np.ndarray
    counted: np.ndarray
    count: int

    @classmethod
    def compute(cls, rows: np.ndarray) -> RowStatistics:
        """Compute the statistics of rows (T, ...)."""
        rows = np.asarray(rows, np.float64)
        known = ~np.isnan(rows)
        filled = np.where(known, rows, 0.0)
        return cls(
            np.where(known, rows, np.inf).min(axis=0),
            np.where(known, rows, -np.inf).max(axis=0),
            filled.sum(axis=0),
            np.square(filled).sum(axis=0),
            known.sum(axis=0),
            len(rows),
        )

    def __add__(self, other: RowStatistics) -> RowStatistics:
        """Return the statistics of both sets of rows together."""
        return RowStatistics(
            np.minimum(self.minimum, other.minimum),
            np.maximum(self.maximum, other.maximum),
            self.total + other.total,
            self.squares + other.squares,
            self.counted + other.counted,
            self.count + other.count,
        )

    def to_lists(self) -> dict[str, list]:
        """Convert to lists "min", "max", "mean", "std" and "count"; zeros if there are no values."""
        known = np.maximum(self.counted, 1)
        mean = self.total / known
        deviation = np.sqrt(np.maximum(self.squares / known - np.square(mean), 0.0))
        arrays = {"min": self.minimum, "max": self.maximum, "mean": mean, "std": deviation}
        lists = {name: np.where(self.counted, array, 0.0) for name, array in arrays.items()}
        return {**{name: np.atleast_1d(array).tolist() for name, array in lists.items()}, "count": [self.count]}


VERSION = "v3.0"  # Version of the LeRobot format.
DEPTH_RANGE = (0.1, 0.6)
"""Depth range [m] for readers that scale depth; tools, cortex and drape of all scenes are within this range."""
EXPORTED = ("colour", "colour_right", "depth", "segmentation", "tumour_mask")  # Exported images.
FILE_MEGABYTES = 100  # Maximum size of a table [MB], as in LeRobot.
FOLDER_FILES = 1000  # Maximum number of tables in a folder, as in LeRobot.
STATISTICS_IMAGES = 5  # Number of images of an episode used for statistics.
STATISTICS_STRIDE = 4  # Pixel stride along each side of the images used for statistics.
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"  # Path of a table of frames.
EPISODES = Path("meta/episodes/chunk-000/file-000.parquet")  # Path of the table of episodes.
IMAGE_TYPE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])  # Parquet type of an image.
# Columns of time and numbers that LeRobot requires in each row.
REQUIRED_COLUMNS = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def write_lerobot(
    episodes: Sequence[EpisodeContents], folder: Path, progress: Callable[[Iterable], Iterable] = iter
) -> dict[str, Any]:
    """Write episodes as a LeRobot data set, atomically; return a summary. `progress` wraps the iteration.

    Raises
    ------
    InputError
        Episodes have no tool, different image sizes or frame rates, or are damaged; the folder cannot be written.
    """
    pictures = list_shared_images(episodes, EXPORTED)
    names = list_shared_numbers(episodes)
    tasks = list(dict.fromkeys(describe_task(one) for one in episodes))
    rates: set[float] = set()
    with write_folder_atomically(folder, measure_stored_size(episodes)) as partial:
        tables = TableWriter(partial)
        rows, whole, shapes = [], {}, {}
        first = 0
        try:
            for index, contents in enumerate(progress(episodes)):
                with open_episode(contents.path) as file:
                    numbers = collect_numbers(file, contents, names)
                    rates.add(compute_frame_rate(contents, numbers.pop("time")))
                    if len(rates) > 1:
                        slow, fast = sorted(rates)
                        raise InputError(f"{contents.path}: {slow:g} and {fast:g} frames a second: convert them apart.")
                    columns = build_columns(contents.frames, index, first, tasks.index(describe_task(contents)), *rates)
                    columns |= {to_key(name): rows_ for name, rows_ in numbers.items()}
                    place = tables.write(file, contents, columns, pictures)
                    spreads = {name: RowStatistics.compute(array) for name, array in columns.items()}
                    spreads |= {
                        f"observation.images.{name}": measure_image_statistics(file, contents, name)
                        for name in pictures
                    }
                rows.append(
                    {
                        "episode_index": index,
                        "tasks": [describe_task(contents)],
                        "length": contents.frames,
                        "data/chunk_index": place[0],
                        "data/file_index": place[1],
                        "dataset_from_index": first,
                        "dataset_to_index": first + contents.frames,
                        "meta/episodes/chunk_index": 0,
                        "meta/episodes/file_index": 0,
                        **{
                            f"stats/{name}/{key}": value
                            for name, spread in spreads.items()
                            for key, value in to_lerobot_statistics(name, spread).items()
                        },
                    }
                )
                whole = {name: whole[name] + spread if whole else spread for name, spread in spreads.items()}
                shapes = {name: array.shape[1:] for name, array in columns.items()}
                first += contents.frames
        finally:
            tables.close()
        (partial / "meta").mkdir()
        (partial / EPISODES).parent.mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(rows), partial / EPISODES)
        pq.write_table(build_task_table(tasks), partial / "meta/tasks.parquet")
        write_json(
            partial / "meta/stats.json", {name: to_lerobot_statistics(name, spread) for name, spread in whole.items()}
        )
        features = {**describe_features(shapes), **describe_image_features(episodes[0], pictures)}
        described = build_info(len(episodes), first, len(tasks), rates.pop(), features)
        write_json(partial / "meta/info.json", described)
        write_json(partial / "meta/spaces.json", {"spaces": SPACE})
        write_notices(episodes, partial)
    return {"out": str(folder), "episodes": len(episodes), "frames": first, "features": sorted(features)}


def to_key(name: str) -> str:
    """Return LeRobot's name for an array."""
    return "action" if name == "action" else f"observation.{name}"


def build_columns(frame_count: int, episode: int, first_row: int, task: int, rate: float) -> dict[str, np.ndarray]:
    """Build the columns that every LeRobot data set requires, for one episode; `first_row` is its first row."""
    every = np.arange(frame_count)
    same = np.ones(frame_count, np.int64)
    numbers = ((every / rate).astype(np.float32), every, episode * same, first_row + every, task * same)
    return dict(zip(REQUIRED_COLUMNS, numbers, strict=True))


@dataclass
class TableWriter:
    """Writer of frames into tables (Parquet files) of limited size."""

    folder: Path
    number: int = -1
    writer: pq.ParquetWriter | None = None
    path: Path = field(default_factory=Path)

    def write(
        self, file: h5py.File, contents: EpisodeContents, columns: Mapping[str, np.ndarray], image_names: Sequence[str]
    ) -> tuple[int, int]:
        """Write the frames of an episode; return the numbers of the folder and of the file."""
        if self.writer is not None and self.path.stat().st_size > 1e6 * FILE_MEGABYTES:
            self.close()
        for block in split_into_blocks(len(columns["index"])):
            arrays = {name: to_arrow_column(array[block.start : block.stop]) for name, array in columns.items()}
            for name in image_names:
                arrays[f"observation.images.{name}"] = pa.array(encode_images(file, contents, name, block), IMAGE_TYPE)
            table = pa.table(arrays)
            if self.writer is None:
                self.number += 1
                chunk, place = divmod(self.number, FOLDER_FILES)
                self.path = self.folder / DATA.format(chunk_index=chunk, file_index=place)
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self.writer = pq.ParquetWriter(self.path, table.schema)
            self.writer.write_table(table)
        return divmod(self.number, FOLDER_FILES)

    def close(self) -> None:
        """Close the current table."""
        if self.writer is not None:
            self.writer.close()
            self.writer = None


def encode_images(file: h5py.File, contents: EpisodeContents, name: str, frames: range) -> Iterator[dict[str, Any]]:
    """Yield the encoded images of some frames as LeRobot stores images: bytes and path."""
    suffix = get_suffix(name)
    return (
        {"bytes": read_image_bytes(file, contents, name, frame), "path": f"{name}_{frame:06d}.{suffix}"}
        for frame in frames
    )


def to_arrow_column(array: np.ndarray) -> pa.Array:
    """Convert rows (T, ...) to an Arrow column of numbers, vectors, or nested lists."""
    if array.ndim == 1:
        return pa.array(array)
    if array.ndim == 2:
        return pa.FixedSizeListArray.from_arrays(array.ravel(), array.shape[1])
    inner = pa.array(array.reshape(-1))
    for length in array.shape[:0:-1]:
        ends = np.arange(0, len(inner) + 1, length, dtype=np.int32)
        inner = pa.ListArray.from_arrays(ends, inner)
    return inner


def measure_image_statistics(file: h5py.File, contents: EpisodeContents, name: str) -> RowStatistics:
    """Compute statistics of a few images of an episode; colour and labels relative to 255, depth in its steps."""
    found = []
    for frame in np.unique(np.linspace(0, contents.frames - 1, STATISTICS_IMAGES).round().astype(int)).tolist():
        picture = read_one_image(file, contents, name, frame)[::STATISTICS_STRIDE, ::STATISTICS_STRIDE]
        scale = contents.depth_scale if PICTURES[name] == DEPTH else 255.0
        found.append(picture.reshape(-1, picture.shape[2] if picture.ndim == 3 else 1) / scale)
    return RowStatistics.compute(np.concatenate(found))


def to_lerobot_statistics(name: str, statistics: RowStatistics) -> dict[str, list]:
    """Convert statistics to LeRobot's format, in which statistics of images have the shape (channels, 1, 1)."""
    said = statistics.to_lists()
    if not name.startswith("observation.images."):
        return said
    return {key: value if key == "count" else [[[one]] for one in value] for key, value in said.items()}


def build_task_table(tasks: Sequence[str]) -> pa.Table:
    """Build the table of task sentences and task numbers; the sentence is the index in pandas."""
    index = "__index_level_0__"
    table = pa.table({"task_index": np.arange(len(tasks)), index: list(tasks)})
    kinds = (("task_index", "int64", "int64"), (index, "unicode", "object"))
    columns = [
        {
            "name": None if name == index else name,
            "field_name": name,
            "pandas_type": of_pandas,
            "numpy_type": of_numpy,
            "metadata": None,
        }
        for name, of_pandas, of_numpy in kinds
    ]
    described = {"index_columns": [index], "column_indexes": [], "columns": columns}
    return table.replace_schema_metadata({"pandas": json.dumps(described)})


def describe_features(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
    """Describe the numeric columns for `info.json`, given the shapes of their rows."""
    kinds = {name: "float32" if name not in REQUIRED_COLUMNS or name == "timestamp" else "int64" for name in shapes}
    return {
        name: {"dtype": kinds[name], "shape": list(shape) or [1], "names": name_axes(name.rpartition(".")[2])}
        for name, shape in shapes.items()
    }


def describe_image_features(contents: EpisodeContents, image_names: Sequence[str]) -> dict[str, Any]:
    """Describe the images for `info.json`; depth images with the step and the range of depth [m]."""
    width, height = contents.size
    found = {}
    for name in image_names:
        channels = 3 if PICTURES[name] == COLOUR else 1
        found[f"observation.images.{name}"] = {
            "dtype": "image",
            "shape": [height, width, channels],
            "names": ["height", "width", "channels"],
        }
        if PICTURES[name] == DEPTH:
            found[f"observation.images.{name}"]["info"] = {
                "is_depth_map": True,
                "step_m": contents.depth_scale,
                "range_m": list(DEPTH_RANGE),
                "bits": 16,
            }
    return found


def build_info(episodes: int, frames: int, tasks: int, rate: float, features: Mapping[str, Any]) -> dict[str, Any]:
    """Build the content of `info.json`."""
    return {
        "codebase_version": VERSION,
        "robot_type": "simulated hand-held tool",
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": tasks,
        "chunks_size": FOLDER_FILES,
        "data_files_size_in_mb": FILE_MEGABYTES,
        "video_files_size_in_mb": FILE_MEGABYTES,
        "fps": int(rate) if rate.is_integer() else rate,
        "splits": {"train": f"0:{episodes}"},
        "data_path": DATA,
        "video_path": None,
        "features": dict(features),
    }


def write_json(path: Path, value: Any) -> None:
    """Write a value as indented JSON."""
    path.write_text(json.dumps(value, indent=1, allow_nan=False) + "\n")
