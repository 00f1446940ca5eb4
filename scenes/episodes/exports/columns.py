"""Columns of exported episodes: task, held-out flag, images, frame rate, states, actions and other numbers."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import count
from pathlib import Path

import h5py
import numpy as np
from scipy.spatial.transform import Rotation

from sim.errors import InputError

from ..reading.contents import MAX_TEXT_BYTES, EpisodeContents
from ..reading.schema import PICTURES
from ..reading.windows import read_numbers

TASKS = {  # Descriptions of tasks, by family.
    "press": "Press one position of the open cortex, hold, and release.",
    "slide": "Press, slide along a straight line over the open cortex, and release.",
    "draw": "Lay the tool on the open cortex, and draw the tissue aside.",
    "reach": "Touch several positions of the open cortex one after another, with smooth motions.",
    "walk": "Move over the open cortex at random, always in contact.",
    "palpate": "Move a ball by its pose over the open cortex, to palpate it at several positions.",
    "retract": "Draw the cortex aside with a spatula, and hold it while the tissue relaxes.",
    "drain": "Drain fluid and turn the head, while the brain sinks.",
    "debulk": "Resect the tumour in steps.",
}
HELD_OUT_STRIDE = 10  # One in this many bodies (or episodes, if there are fewer bodies) is held out.


def describe_task(contents: EpisodeContents) -> str:
    """Return a sentence that describes the task of an episode's family, or names its scene."""
    return TASKS.get(contents.family, f"Play the scene {contents.family}.")


def mark_held_out(episodes: Sequence[EpisodeContents]) -> list[bool]:
    """Return a held-out flag for each episode: every tenth body, or every tenth episode of fewer than ten bodies.

    If there are two to nine episodes, the last episode is held out.
    """
    bodies = list(dict.fromkeys(str(one.attributes.get("anatomy")) for one in episodes))
    if len(bodies) < HELD_OUT_STRIDE:
        every = min(HELD_OUT_STRIDE, max(len(episodes), 2))
        return [number % every == every - 1 for number in range(len(episodes))]
    out = set(bodies[HELD_OUT_STRIDE - 1 :: HELD_OUT_STRIDE])
    return [str(one.attributes.get("anatomy")) in out for one in episodes]


TIME_STEP_TOLERANCE = 1e-4  # Largest deviation of the time between frames from the mean [s].
BLOCK_FRAMES = 64  # Number of frames held in memory at once.
NUMBERS = (
    "force", "force_read", "tip", "contact", "distance", "K", "T_camera_world", "T_camera_world_tracked",
    "T_world_tool_tracked", "tumour_predicted",
)  # fmt: skip
"""Names of arrays that are exported unchanged, with one row per frame."""
SPACE = "world: RAS [m]; camera: x right, y down, z forward [m]"
"""Description of the coordinate systems of exported positions."""
# Names of the components of a state: position and unit quaternion of the tool.
STATE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
# Names of the components of an action: translation and rotation vector of the tool.
ACTION = ("dx_m", "dy_m", "dz_m", "rx_rad", "ry_rad", "rz_rad")
SHEET, LICENCE = "DATASHEET.md", "LICENSE.md"
"""File names of the data sheet and the licence."""


def list_shared_images(episodes: Sequence[EpisodeContents], names: Sequence[str] = tuple(PICTURES)) -> tuple[str, ...]:
    """List those of the image names `names` that every episode has.

    Raises
    ------
    InputError
        The episodes' images differ in size.
    """
    for one in episodes:
        if one.size != episodes[0].size:
            sizes = " and ".join(f"{width} x {height}" for width, height in (episodes[0].size, one.size))
            raise InputError(f"{one.path}: images of {sizes} pixels cannot be in one set: convert them separately.")
    return tuple(name for name in names if all(name in one.shapes for one in episodes))


def list_shared_numbers(episodes: Sequence[EpisodeContents]) -> tuple[str, ...]:
    """List those of `NUMBERS` that every episode has with equal row shapes (tumours of two bodies differ)."""
    first = episodes[0].shapes
    return tuple(
        name
        for name in NUMBERS
        if name in first and all(one.shapes.get(name, ())[1:] == first[name][1:] for one in episodes)
        and all(name in one.shapes for one in episodes)
    )  # fmt: skip


def compute_frame_rate(contents: EpisodeContents, time: np.ndarray) -> float:
    """Compute the frame rate [1/s] of an episode with frame times `time` (T,) [s].

    Raises
    ------
    InputError
        Frames are not evenly spaced, or there are fewer than two frames.
    """
    steps = np.diff(time)
    if not len(steps) or not steps.mean() > 0.0 or np.abs(steps - steps.mean()).max() > TIME_STEP_TOLERANCE:
        raise InputError(f"{contents.path}: its frames are not evenly spaced in time: leave it out.")
    return round(1.0 / float(steps.mean()), 6)


def collect_numbers(file: h5py.File, contents: EpisodeContents, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Collect `state` (T, 7), `action` (T, 6) and the arrays `names` as float32; `time` keeps its stored type.

    Raises
    ------
    InputError
        The episode has no tool.
    """
    if "T_world_tool" not in contents.shapes:
        raise InputError(f"{contents.path}: has no tool, and so no actions: leave it out.")
    poses = read_numbers(file, contents, "T_world_tool")
    found = {"state": build_states(poses), "action": build_twists(poses)}
    found |= {name: read_per_frame(file, contents, name).astype(np.float32) for name in names}
    return {**found, "time": read_numbers(file, contents, "time")}


def read_per_frame(file: h5py.File, contents: EpisodeContents, name: str) -> np.ndarray:
    """Read an array with a row per frame (T, ...); `K` is expanded to (T, 3, 3), because a camera may zoom."""
    if name != "K":
        return read_numbers(file, contents, name)
    if "K_of_frame" in contents.shapes:
        return read_numbers(file, contents, "K_of_frame")
    return np.tile(read_numbers(file, contents, "K"), (contents.frames, 1, 1))


def split_into_blocks(frames: int) -> Iterator[range]:
    """Yield ranges of at most `BLOCK_FRAMES` frames that cover all frames."""
    return (range(start, min(start + BLOCK_FRAMES, frames)) for start in range(0, frames, BLOCK_FRAMES))


def name_axes(name: str) -> list[str] | None:
    """Return the component names of the vector `name`; None if its components have no names."""
    return {"state": list(STATE), "action": list(ACTION), "distance": ["m"]}.get(
        name, list("xyz") if name in ("force", "force_read", "tip", "contact") else None
    )


def measure_stored_size(episodes: Sequence[EpisodeContents]) -> int:
    """Return the total file size of the episodes [bytes]."""
    return sum(one.path.stat().st_size for one in episodes)


def name_files(episodes: Sequence[EpisodeContents]) -> Mapping[EpisodeContents, str]:
    """Return a unique name by episode: the file name, with a number if several files have the same name."""
    taken: set[str] = set()
    found = {}
    for one in episodes:
        names = (one.path.stem if not number else f"{one.path.stem}_{number}" for number in count())
        found[one] = next(name for name in names if name not in taken)
        taken.add(found[one])
    return found


def build_states(poses: np.ndarray) -> np.ndarray:
    """Build states (T, 7) float32 from `T_world_tool` (T, 4, 4): origin [m], and x, y, z, w without sign jumps."""
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    flips = np.sign(np.einsum("ij,ij->i", turns[1:], turns[:-1]))
    turns[1:] *= np.cumprod(np.where(flips < 0.0, -1.0, 1.0))[:, None]
    return np.concatenate([poses[:, :3, 3], turns], axis=1).astype(np.float32)


def build_twists(poses: np.ndarray) -> np.ndarray:
    """Build actions (T, 6) float32 from poses (T, 4, 4): translation [m] and rotation [rad] to the next frame.

    Axes are those of the world. The last row is zero.
    """
    shifts = np.diff(poses[:, :3, 3], axis=0)
    turns = Rotation.from_matrix(poses[1:, :3, :3]) * Rotation.from_matrix(poses[:-1, :3, :3]).inv()
    found = np.concatenate([shifts, turns.as_rotvec().reshape(-1, 3)], axis=1)
    return np.concatenate([found, np.zeros((1, 6))]).astype(np.float32)


def collect_texts(episodes: Sequence[EpisodeContents]) -> Mapping[str, str]:
    """Read the data sheets and licences of the episodes' folders, by file name; empty without such files.

    File names are numbered if there are several folders.
    """
    homes = dict.fromkeys(find_dataset_folder(one.path.resolve().parent) for one in episodes)
    found = {}
    for number, home in enumerate(homes):
        for path in (home / SHEET, home / LICENCE):
            if path.is_file() and not path.is_symlink() and path.stat().st_size <= MAX_TEXT_BYTES:
                name = path.name if len(homes) == 1 else f"{path.stem}_{number}{path.suffix}"
                found[name] = path.read_text(encoding="utf-8", errors="replace")
    return found


def write_notices(episodes: Sequence[EpisodeContents], folder: Path) -> None:
    """Write the data sheets and licences of the episodes into a folder."""
    for name, text in collect_texts(episodes).items():
        (folder / name).write_text(text, encoding="utf-8")


def find_dataset_folder(folder: Path) -> Path:
    """Return the folder of a data set, given the folder of its episodes."""
    return folder.parent if folder.name == "episodes" and not (folder / LICENCE).exists() else folder
