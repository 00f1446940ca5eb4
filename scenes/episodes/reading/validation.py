"""Validation of an untrusted episode; each finding is a sentence."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from ar.optics.camera import Camera
from ar.optics.lens import Lens
from ar.overlay.outlines import compute_silhouette
from sim.anatomy import Anatomy
from sim.errors import InputError
from sim.runtime.outside_files import wrap_errors

from ..checksums import CHECKSUM_ATTRIBUTE, find_errors
from .bodies import find_anatomy, find_surface_rows
from .contents import REMEDY, EpisodeContents, format_finding, get_array, inspect_contents, read_attributes
from .schema import ARRAYS, LABELS, PICTURES
from .windows import read_numbers, read_one_image

CHECKED_FRAMES = 12  # Number of frames that are rendered again, spread evenly.
MAX_DIFFERING_SHARE = 1e-3  # Share of a silhouette's pixels that may differ by rounding or machine.
MAX_DIFFERING_PIXELS = 4  # Number of pixels that may differ in addition.
BLOCK_ROWS = 256  # Number of rows held in memory at once.
ROTATION_TOLERANCE = 1e-6  # Tolerance of a rotation's rows from unit length and right angles.
# Arrays of poses.
POSES = ("T_camera_world", "T_camera_world_right", "T_camera_world_tracked", "T_world_tool", "T_world_tool_tracked")


def check_mask(file: h5py.File, contents: EpisodeContents, anatomy: Anatomy | None) -> tuple[list[str], list[str]]:
    """Compare `tumour_mask` with rendered silhouettes; return faults and skipped checks as sentences."""
    shapes = contents.shapes
    missing = [
        name
        for name in ("tumour_mask", "tumour_predicted", "tumour_nodes", "K", "T_camera_world")
        if name not in shapes
    ]
    if missing:
        return [], [f"silhouettes: there is no {missing[0]!r}"]
    if anatomy is None:
        return [], ["silhouettes: its anatomy is neither the template nor in `bodies` next to it"]
    nodes = read_numbers(file, contents, "tumour_nodes")
    triangles = find_surface_rows(anatomy.tumour_surface, nodes)
    if len(triangles) < len(anatomy.tumour_surface):
        return ["'tumour_nodes' are not those of its anatomy."], []
    whole = np.ones(contents.frames, bool)
    if "tumour_left" in shapes:
        whole = read_numbers(file, contents, "tumour_left").all(axis=1)
    frames = np.flatnonzero(whole)
    left = [] if whole.all() else [f"silhouettes of {int((~whole).sum())} frames in which tumour is cut out"]
    for frame in frames[np.unique(np.linspace(0, len(frames) - 1, CHECKED_FRAMES).astype(int))] if len(frames) else ():
        found = read_one_image(file, contents, "tumour_mask", int(frame)) > 0
        at = read_numbers(file, contents, "tumour_predicted", range(frame, frame + 1))[0]
        try:
            truth = compute_silhouette(read_episode_camera(file, contents, int(frame)), at, triangles)
        except (ValueError, InputError) as error:
            return [f"frame {frame} has no camera that draws: {error}"], left
        off = int(np.count_nonzero(found != truth))
        if off > MAX_DIFFERING_PIXELS + MAX_DIFFERING_SHARE * np.count_nonzero(truth):
            return [
                f"'tumour_mask' of frame {frame} differs in {off} of {np.count_nonzero(truth)} pixels from the "
                "silhouette of 'tumour_predicted'."
            ], left
    return [], left


def read_episode_camera(file: h5py.File, contents: EpisodeContents, frame: int) -> Camera:
    """Build the camera of a frame; raise ValueError if its parameters are invalid."""
    moves = "K_of_frame" in contents.shapes
    K = (
        read_numbers(file, contents, "K_of_frame", range(frame, frame + 1))[0]
        if moves
        else read_numbers(file, contents, "K")
    )
    pose = read_numbers(file, contents, "T_camera_world", range(frame, frame + 1))[0]
    lens = Lens(*read_numbers(file, contents, "distortion").tolist()) if "distortion" in contents.shapes else None
    return Camera(K, pose, *contents.size, lens)


@dataclass(frozen=True)
class Report:
    """Findings of the validation of one file.

    Parameters
    ----------
    path
        Path of the file.
    problems
        Faults, as sentences; empty if the file is complete and correct.
    skipped
        Skipped checks, with their reasons.
    frames, solved
        Number of frames, and number of frames that FEM solved.
    unsolved
        Number of FEM solutions that did not converge.
    error_mm
        Mean and maximum error of predicted tumour vertices relative to FEM over solved frames [mm]; None without
        solved frames, or if FEM played the scene.
    again, again_mm
        Number of frames that were solved again, and maximum difference of tumour positions from the file [mm].
    """

    path: Path
    problems: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    frames: int = 0
    solved: int = 0
    unsolved: int = 0
    error_mm: tuple[float, float] | None = None
    again: int = 0
    again_mm: float | None = None


def validate_episode(path: Path) -> Report:
    """Check the arrays, images and attributes of one episode; return the findings."""
    problems: list[str] = []
    skipped: list[str] = []
    try:
        with wrap_errors(path, "an episode", REMEDY), h5py.File(path, "r") as file:
            contents = inspect_contents(file, path)
            for check in (check_units, check_numbers, check_poses, check_images):
                problems += check(file, contents)
            if CHECKSUM_ATTRIBUTE in contents.attributes:
                problems += [f"{words}." for words in find_errors(file)]
            else:
                skipped.append("checksums: it states none")
            if not problems:
                anatomy = find_anatomy(contents)
                wrong, left = check_mask(file, contents, anatomy)
                problems += wrong
                skipped += left
            solved, unsolved, error = count_solved_frames(file, contents)
            return Report(path, problems, skipped, contents.frames, solved, unsolved, error)
    except InputError as error:
        return Report(path, [*problems, format_finding(error, path)], skipped)


def check_units(file: h5py.File, contents: EpisodeContents) -> Iterator[str]:
    """Yield findings on missing or unexpected units of arrays."""
    for name in contents.shapes:
        if name in PICTURES:
            continue
        unit, said = ARRAYS[name].unit, read_attributes(get_array(file, name)).get("unit")
        if name not in ("fem_frames",) and unit is not None and said != unit:
            yield f"'{name}' has the unit {said!r} in place of {unit!r}."


def check_numbers(file: h5py.File, contents: EpisodeContents) -> Iterator[str]:
    """Yield findings on forbidden NaN and infinite values, and on times that do not increase."""
    for name in contents.shapes:
        if name in PICTURES or ARRAYS[name].kind != "f":
            continue
        array = get_array(file, name)
        for start in range(0, array.shape[0], BLOCK_ROWS):
            rows = array[start : start + BLOCK_ROWS]
            wrong = (np.isnan(rows) & ARRAYS[name].known) | (np.isinf(rows) & ARRAYS[name].limited)
            if wrong.any():
                row = start + int(np.argwhere(wrong)[0][0])
                yield f"'{name}' has a number in row {row} that is not finite."
                break
    times = read_numbers(file, contents, "time")
    if (np.diff(times) <= 0.0).any():
        row = int(np.argmax(np.diff(times) <= 0.0)) + 1
        yield f"'time' does not grow from row {row - 1} to row {row}."


def check_poses(file: h5py.File, contents: EpisodeContents) -> Iterator[str]:
    """Yield findings on poses that are not rigid motions, and on invalid camera matrices."""
    for name in POSES:
        if name not in contents.shapes:
            continue
        poses = read_numbers(file, contents, name)
        known = np.isfinite(poses).all(axis=(1, 2))
        turns = poses[:, :3, :3]
        with np.errstate(all="ignore"):
            off = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
            rigid = (
                (off < ROTATION_TOLERANCE)
                & (np.linalg.det(turns) > 0.0)
                & (poses[:, 3] == [0.0, 0.0, 0.0, 1.0]).all(axis=1)
            )
        if (known & ~rigid).any():
            yield f"'{name}' of row {int(np.argmax(known & ~rigid))} is no rotation and translation."
    for name in ("K", "K_of_frame"):
        if name in contents.shapes:
            found = read_numbers(file, contents, name).reshape(-1, 3, 3)
            good = (found[:, 0, 0] > 0.0) & (found[:, 1, 1] > 0.0) & (found[:, 2] == [0.0, 0.0, 1.0]).all(axis=1)
            if not good.all():
                yield f"'{name}' is no matrix of a camera."


def check_images(file: h5py.File, contents: EpisodeContents) -> Iterator[str]:
    """Yield findings on images that cannot be decoded, have a wrong size, or contain labels without a name."""
    stored = str(contents.attributes.get("segmentation", ""))
    labels = {int(word.split()[0]) for word in stored.split(",") if word.strip()}
    for name, kind in PICTURES.items():
        if name not in contents.shapes:
            continue
        allowed = {0, 1} if name == "tumour_mask" else labels
        for frame in range(contents.frames):
            try:
                picture = read_one_image(file, contents, name, frame)
            except InputError as error:
                yield format_finding(error, contents.path).removesuffix(" Make the episode again.")
                break
            if kind == LABELS and not (found := set(np.unique(picture).tolist())) <= allowed:
                yield f"the image {name!r} of frame {frame} has labels {sorted(found - allowed)} without a name."
                break


def count_solved_frames(file: h5py.File, contents: EpisodeContents) -> tuple[int, int, tuple[float, float] | None]:
    """Return the numbers of solved and of unconverged frames, and mean and maximum error of the prediction [mm].

    The errors are None if FEM played the scene, or if errors cannot be computed.
    """
    solved = len(contents.fem_frames)
    unsolved = 0
    if "outcome_fem" in contents.shapes:
        unsolved = sum(not text.startswith(b"CONVERGED") for text in get_array(file, "outcome_fem")[:])
    played = contents.attributes.get("deformer") == "fem"
    if played or not solved or not {"tumour_fem", "tumour_predicted"} <= set(contents.shapes):
        return solved, unsolved, None
    truth, total, worst = get_array(file, "tumour_fem"), 0.0, 0.0
    for start in range(0, solved, BLOCK_ROWS):
        frames = contents.fem_frames[start : start + BLOCK_ROWS]
        away = np.linalg.norm(get_array(file, "tumour_predicted")[frames] - truth[start : start + BLOCK_ROWS], axis=2)
        total, worst = total + float(away.mean()) * len(frames), max(worst, float(away.max(initial=0.0)))
    return solved, unsolved, (1e3 * total / solved, 1e3 * worst)
