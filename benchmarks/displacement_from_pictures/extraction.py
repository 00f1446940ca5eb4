"""Episodes of a data set to `Frames`: only what is measured goes in, and only as it is measured."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import h5py
import numpy as np
from frames import AXES, FORCE, POSE, Frames, joined

from scenes.episodes.plan import plan_from
from scenes.episodes.reading.contents import Contents, read_contents
from scenes.episodes.reading.open_files import opened
from scenes.episodes.reading.rows import numbers_in, rows_of
from scenes.episodes.reading.windows import episode_paths
from scenes.episodes.run_folder import EPISODE
from sim.deformation import Outcome
from sim.errors import InputError

DEPTH_STEP_MM, DEPTH_FROM_MM = 0.4, -80.0
"""A step of depth, and where it begins, from the middle of the planned tumour: 1 to 255 are -80 to 21.6 mm."""

MOST_EPISODES = 10**9


def extracted(
    folder: Path,
    every: int,
    width: int,
    workers: int,
    first: int = 0,
    count: int | None = None,
    progress: Callable[[Iterable], Iterable] = iter,
) -> Frames:
    """Every so many frames of the episodes of a folder from number `first` on, with pictures of such a width.

    Raises
    ------
    InputError
        A folder without episodes, one that is damaged or of no plan, or a width that does not divide the pictures'.
    """
    numbered = ((path, EPISODE.fullmatch(path.name)) for path in episode_paths(folder))
    paths = [path for path, found in numbered if found and first <= int(found[1]) < first + (count or MOST_EPISODES)]
    if not paths:
        raise InputError(f"{folder}: holds no episode of these numbers. Give other --first and --count.")
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        parts = list(progress(pool.map(partial(frames_of, every=every, width=width), paths)))
    return joined(parts)


def frames_of(path: Path, every: int, width: int) -> Frames:
    """Frames of one episode; InputError as `extracted`."""
    contents = read_contents(path)
    with opened(path) as file:
        return _frames(file, contents, range(0, contents.frames, every), width)


def _frames(file: h5py.File, contents: Contents, taken: range, width: int) -> Frames:
    said, count = contents.said, len(taken)
    missing = [name for name in ("plan", "episode", "body") if name not in said]
    if missing:
        raise InputError(f"{contents.path}: states no {missing[0]}. Give episodes of `sulcus episodes`.")

    def read(name: str) -> np.ndarray:
        return numbers_in(file, contents, name, taken)

    rest = read("tumour_rest")
    middle = rest.mean(axis=0)
    camera = read("T_camera_world_tracked")
    turn = camera[:, :3, :3]
    left = read("tumour_left")[..., None]

    def moved(name: str) -> np.ndarray:
        """Displacement of the middle of what is left of the tumour [mm], in the camera's axes."""
        shift = np.where(left, read(name) - rest, 0.0).sum(axis=1) / np.maximum(left.sum(axis=1), 1)
        return 1e3 * np.einsum("tij,tj->ti", turn, shift)

    outcomes = {
        name: np.array(_good(rows_of(file, contents, name, taken))) for name in ("outcome_predicted", "outcome_fem")
    }
    some = left.any(axis=1)[:, 0]
    solved_every = plan_from(str(said["plan"]), "plan", Path()).contents.solved_every
    times = np.asarray(taken)
    # In the first frame nothing has moved; where finite elements play, frames as rare as elsewhere are tested.
    tested = outcomes["outcome_fem"] & some & (times > 0) & (times % solved_every == 0)
    measured = {**_scanned(rest, read("cortex_rest"), camera, turn), **_tool(contents, read, middle, turn)}
    focal = read("K_of_frame") if "K_of_frame" in contents.shapes else np.tile(read("K"), (count, 1, 1))
    measured["focal"] = focal[:, 1, 1] / contents.size[1]
    measured |= _force(contents, read, turn)
    return Frames(
        picture=_pictures(file, contents, taken, width, 1e3 * (camera @ [*middle, 1.0])[:, 2]),
        pose=np.stack([np.broadcast_to(measured[name], count) for name in POSE], axis=1).astype(np.float32),
        force=np.stack([np.broadcast_to(measured[name], count) for name in FORCE], axis=1).astype(np.float32),
        turn=turn.astype(np.float32),
        label=moved("tumour_predicted").astype(np.float32),
        truth=np.where(tested[:, None], moved("tumour_fem"), np.nan).astype(np.float32),
        usable=outcomes["outcome_predicted"] & some,
        episode=np.full(count, int(said["episode"])),
        body=np.full(count, int(said["body"])),
        frame=times,
        family=np.full(count, contents.family, "U16"),
    )


def _good(names: Sequence[str] | np.ndarray) -> list[bool]:
    return [name in Outcome.__members__ and Outcome[name].good for name in names]


def _named(name: str, vectors: np.ndarray) -> dict[str, np.ndarray]:
    """Components (n,) of vectors (n, 3) by name."""
    return {f"{name}_{axis}": vectors[:, place] for place, axis in enumerate(AXES)}


def _scanned(rest: np.ndarray, cortex: np.ndarray, camera: np.ndarray, turn: np.ndarray) -> dict[str, np.ndarray]:
    """What the scan says, seen by the tracked camera."""
    middle, opening = rest.mean(axis=0), cortex.mean(axis=0)
    normal = np.linalg.svd(cortex - opening)[2][2]
    normal *= np.sign(normal @ (opening - middle)) or 1.0
    return {
        **_named("tumour", 1e3 * (camera @ [*middle, 1.0])[:, :3]),
        **_named("opening", 1e3 * turn @ (opening - middle)),
        **_named("opening_normal", turn @ normal),
        "tumour_radius": 1e3 * np.linalg.norm(rest - middle, axis=1).mean(keepdims=True),
    }


def _tool(
    contents: Contents, read: Callable[[str], np.ndarray], middle: np.ndarray, turn: np.ndarray
) -> dict[str, np.ndarray]:
    """The tool as it is tracked, from the middle of the planned tumour."""
    if "T_world_tool_tracked" not in contents.shapes:
        nowhere = np.zeros((len(turn), 3))
        return {
            **_named("tool", nowhere), **_named("tool_axis", nowhere),
            "tool_radius": np.zeros(1), "tool_known": np.zeros(1),
        }  # fmt: skip
    tool = read("T_world_tool_tracked")
    return {
        **_named("tool", 1e3 * np.einsum("tij,tj->ti", turn, tool[:, :3, 3] - middle)),
        **_named("tool_axis", np.einsum("tij,tj->ti", turn, tool[:, :3, 2])),
        "tool_radius": np.array([1e3 * float(contents.said["footprint_m"])]),
        "tool_known": np.ones(1),
    }


def _force(contents: Contents, read: Callable[[str], np.ndarray], turn: np.ndarray) -> dict[str, np.ndarray]:
    """The force as it is read."""
    if "force_read" not in contents.shapes:
        return {**_named("force", np.zeros((len(turn), 3))), "force_known": np.zeros(1)}
    return {**_named("force", np.einsum("tij,tj->ti", turn, read("force_read"))), "force_known": np.ones(1)}


def _pictures(file: h5py.File, contents: Contents, taken: range, width: int, far: np.ndarray) -> np.ndarray:
    """Means of square blocks; depth [mm] of what is seen in them, from the planned tumour, which is `far` (n,) away."""
    wide, high = contents.size
    block = wide // width
    if wide % width or high % block:
        raise InputError(
            f"{contents.path}: pictures of {wide} x {high} are not made {width} wide. Choose another --width."
        )
    found = np.empty((len(taken), high // block, width, 4), np.uint8)
    for place, frame in enumerate(taken):
        one = range(frame, frame + 1)
        colour, depth = (numbers_in(file, contents, name, one)[0] for name in ("colour", "depth"))
        found[place, ..., :3] = np.rint(_blocks(colour.astype(np.float32), block))
        seen = _blocks((depth > 0.0).astype(np.float32), block)
        metres = _blocks(depth, block) / np.maximum(seen, 1e-6)
        steps = (1e3 * metres - far[place] - DEPTH_FROM_MM) / DEPTH_STEP_MM
        found[place, ..., 3] = np.where(seen > 0.0, np.clip(np.rint(steps), 1, 255), 0)
    return found


def _blocks(picture: np.ndarray, block: int) -> np.ndarray:
    """Means of square blocks of a picture (H, W, ...)."""
    high, wide = picture.shape[0] // block, picture.shape[1] // block
    return picture.reshape(high, block, wide, block, *picture.shape[2:]).mean(axis=(1, 3))
