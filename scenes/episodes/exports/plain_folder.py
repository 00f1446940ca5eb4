"""Export of episodes as folders: images as JPEG and PNG files, numbers as CSV, and a description as JSON."""

import csv
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sim.runtime.atomic_files import write_folder_atomically

from ..reading.contents import EpisodeContents, open_episode
from ..reading.schema import ARRAYS, PICTURES, SOLVED, get_suffix
from ..reading.windows import read_image_bytes, read_numbers, read_rows
from .columns import measure_stored_size, name_files, write_notices

SEPARATE_TABLES = ("tumour_predicted", "tumour_fem", "tumour_left", "cortex_predicted", "cortex_fem")
"""Names of arrays with many numbers per frame, each of which has its own table."""


def write_folder(
    episodes: Sequence[EpisodeContents], folder: Path, progress: Callable[[Iterable], Iterable] = iter
) -> dict[str, Any]:
    """Write a folder for each episode, atomically; return a summary. `progress` wraps the iteration.

    Raises
    ------
    InputError
        An episode is damaged, or the folder cannot be written.
    """
    with write_folder_atomically(folder, 2 * measure_stored_size(episodes)) as partial:
        names = name_files(episodes)
        for contents in progress(episodes):
            place = partial / names[contents]
            place.mkdir()
            with open_episode(contents.path) as file:
                write_images(place, file, contents)
                write_tables(place, file, contents)
                write_description(place / "episode.json", file, contents)
        write_notices(episodes, partial)
    return {"out": str(folder), "episodes": len(episodes), "frames": sum(one.frames for one in episodes)}


def write_images(folder: Path, file: h5py.File, contents: EpisodeContents) -> None:
    """Write the encoded images to files such as `colour/000000.jpg`."""
    for name in PICTURES:
        if name in contents.shapes:
            (folder / name).mkdir()
            suffix = get_suffix(name)
            for frame in range(contents.frames):
                (folder / name / f"{frame:06d}.{suffix}").write_bytes(read_image_bytes(file, contents, name, frame))


def write_tables(folder: Path, file: h5py.File, contents: EpisodeContents) -> None:
    """Write `frames.csv` with a row per frame, and a table for each of `SEPARATE_TABLES`; NaN is an empty field."""
    columns: dict[str, Sequence[object] | np.ndarray] = {"frame": range(contents.frames)}
    for name in contents.shapes:
        described = ARRAYS.get(name)
        if described is None or name == "fem_frames" or not (described.has_frame_axis or described.axes[0] == SOLVED):
            continue
        rows = read_rows(file, contents, name)
        if name in SEPARATE_TABLES:
            flat = np.asarray(rows).reshape(contents.frames, -1)
            axes = [f"{node}{axis}" for node in range(flat.shape[1] // 3) for axis in ("_x", "_y", "_z")]
            titles = axes if described.axes[-1] == 3 else [str(node) for node in range(flat.shape[1])]
            write_table(
                folder / f"{name}.csv", {"frame": range(contents.frames)} | dict(zip(titles, flat.T, strict=True))
            )
        elif isinstance(rows, list) or rows.ndim == 1:
            columns[name] = rows
        else:
            flat = rows.reshape(contents.frames, -1)
            columns |= {f"{name}_{folder}": flat[:, folder] for folder in range(flat.shape[1])}
    write_table(folder / "frames.csv", columns)


def write_table(path: Path, columns: dict[str, Any]) -> None:
    """Write columns of equal length as CSV, by title; NaN is an empty field."""
    with path.open("w", newline="") as out:
        writer = csv.writer(out)
        writer.writerow(columns)
        writer.writerows([("" if one != one else one) for one in row] for row in zip(*columns.values(), strict=True))


def write_description(path: Path, file: h5py.File, contents: EpisodeContents) -> None:
    """Write the episode's attributes, the meaning and unit of each array, and arrays without frame axis as JSON."""
    arrays = {}
    for name in contents.shapes:
        item = file[f"pictures/{name}" if name in PICTURES else name]
        arrays[name] = {key: str(item.attrs[key]) for key in ("meaning", "unit") if key in item.attrs}
        described = ARRAYS.get(name)
        if described is not None and not described.has_frame_axis and described.axes[0] != SOLVED:
            arrays[name]["values"] = read_numbers(file, contents, name).tolist()
    said = {
        name: value if isinstance(value, str | int | float | list) else str(value)
        for name, value in contents.attributes.items()
    }
    path.write_text(json.dumps({"attributes": said, "arrays": arrays}, indent=1) + "\n")
