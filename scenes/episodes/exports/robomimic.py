"""Export of episodes as one robomimic file: HDF5 with `data/demo_0`, ..., and masks for training and validation."""

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sim.runtime.atomic_files import Stream, check_disk_space, write_stream_atomically
from sim.runtime.versions import get_version

from ..reading.contents import EpisodeContents, open_episode
from ..reading.schema import COLOUR, PICTURES
from ..reading.windows import read_numbers
from .columns import (
    SPACE,
    collect_numbers,
    collect_texts,
    compute_frame_rate,
    describe_task,
    list_shared_images,
    list_shared_numbers,
    mark_held_out,
    measure_stored_size,
    split_into_blocks,
)

EXPORTED = ("colour", "colour_right", "depth", "segmentation")  # Exported images.
IMAGE_SIZE_FACTOR = 4  # Size of decoded images compressed by gzip, relative to the episodes' JPEG and PNG.
GYM = 2
"""robomimic's number for Gymnasium environments."""


def write_robomimic(
    episodes: Sequence[EpisodeContents], path: Path, progress: Callable[[Iterable], Iterable] = iter
) -> dict[str, Any]:
    """Write episodes as a robomimic file, atomically; return a summary. `progress` wraps the iteration.

    Raises
    ------
    InputError
        Episodes have no tool, different image sizes, or are damaged; the file cannot be written.
    """
    pictures, names = list_shared_images(episodes, EXPORTED), list_shared_numbers(episodes)
    check_disk_space(path, IMAGE_SIZE_FACTOR * measure_stored_size(episodes))
    total, rates = 0, []
    with write_stream_atomically(path, ".hdf5") as stream, h5py.File(stream, "w") as out:
        data = out.create_group("data")
        for number, contents in enumerate(progress(episodes)):
            demo = data.create_group(f"demo_{number}")
            with open_episode(contents.path) as file:
                numbers = collect_numbers(file, contents, names)
                rates.append(compute_frame_rate(contents, numbers.pop("time")))
                obs = demo.create_group("obs")
                write_demo(demo, obs, contents, numbers)
                write_images(obs, file, contents, pictures, stream)
            total += contents.frames
        data.attrs.update(
            {"total": total, "env_args": json.dumps(describe_environment(episodes, rates)), "space": SPACE}
        )
        names_of = np.array([f"demo_{number}" for number in range(len(episodes))], "S")
        out_of = np.array(mark_held_out(episodes))
        out.create_dataset("mask/train", data=names_of[~out_of])
        out.create_dataset("mask/valid", data=names_of[out_of])
        for name, text in collect_texts(episodes).items():
            out[name] = text
    return {"out": str(path), "episodes": len(episodes), "frames": total, "held_out": int(out_of.sum())}


def write_demo(demo: h5py.Group, obs: h5py.Group, contents: EpisodeContents, values: dict[str, np.ndarray]) -> None:
    """Write one episode without images; a state is the tool's state, followed by the tumour's positions if exported."""
    actions, state = values.pop("action"), values.pop("state")
    tumour = [values[name].reshape(contents.frames, -1) for name in ("tumour_predicted",) if name in values]
    dones = np.zeros(contents.frames, np.int64)
    dones[-1] = 1
    demo.create_dataset("actions", data=actions)
    demo.create_dataset("states", data=np.concatenate([state, *tumour], axis=1))
    demo.create_dataset("rewards", data=np.zeros(contents.frames))
    demo.create_dataset("dones", data=dones)
    for name, rows in {"tool_position": state[:, :3], "tool_quaternion": state[:, 3:], **values}.items():
        obs.create_dataset(name, data=rows.reshape(contents.frames, -1))
    demo.attrs.update({"num_samples": contents.frames, "task": describe_task(contents), "episode": contents.path.name})


def write_images(
    obs: h5py.Group, file: h5py.File, contents: EpisodeContents, names: Sequence[str], stream: Stream
) -> None:
    """Write decoded images (T, H, W, channels): uint8, or float32 [m] for depth."""
    width, height = contents.size
    for name in names:
        kind = np.float32 if name == "depth" else np.uint8
        channels = 3 if PICTURES[name] == COLOUR else 1
        shape = (height, width, channels)
        store = obs.create_dataset(
            f"{name}_image", (contents.frames, *shape), kind, chunks=(1, *shape), compression="gzip",
            compression_opts=1, shuffle=name == "depth",
        )  # fmt: skip
        for block in split_into_blocks(contents.frames):
            rows = read_numbers(file, contents, name, block).reshape(len(block), *shape)
            store[block.start : block.stop] = rows
            if stream.failure is not None:
                raise stream.failure


def describe_environment(episodes: Sequence[EpisodeContents], rates: Sequence[float]) -> dict[str, Any]:
    """Build robomimic's environment metadata, which name the scenes because no environment replays the actions."""
    families = sorted({one.family for one in episodes})
    return {
        "env_name": "sulcus",
        "type": GYM,
        "env_version": get_version("sulcus"),
        "env_kwargs": {"families": families, "frames_per_second": sorted(set(rates))},
    }
