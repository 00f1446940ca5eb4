"""Repeated FEM solution of frames of an episode, from its plan and body only, for validation."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from sim.errors import InputError
from sim.runtime.device import find_device
from sim.runtime.file_limits import limit_memory
from sim.runtime.outside_files import wrap_errors
from sim.runtime.processes import LostProcessError, map_parallel

from ...play.reference import build_reference_fem, is_history_dependent, solve_reference_frames
from ..make import OpenedBody, open_body, to_body_path
from ..plan import parse_plan
from ..scripted import build_scene, sample_episode
from .contents import REMEDY, format_finding, inspect_contents
from .validation import Report, validate_episode
from .windows import read_numbers

TRAINING_TOLERANCE_MM = 0.02  # Largest difference of two solutions at training accuracy [mm].
LIVE_TOLERANCE_MM = 0.2  # Largest difference of two solutions in played frames, at live accuracy [mm].
MAX_MEMORY = 8 * 1024**3  # Maximum memory for the examination of one file [bytes].


def solve_frames_again(report: Report, count: int, device: str = "auto") -> Report:
    """Solve `count` frames of an episode again; return the report extended by differences of the tumour position.

    Frames are evenly spaced. If solutions depend on the history, all earlier solved frames are solved too, in order.
    """
    try:
        with wrap_errors(report.path, "an episode", REMEDY), h5py.File(report.path, "r") as file:
            contents = inspect_contents(file, report.path)
            missing = [name for name in ("plan", "seed", "episode", "body") if name not in contents.attributes]
            if missing or "tumour_fem" not in contents.shapes:
                return _add_skipped(report, f"frames solved again: it states no {(*missing, 'tumour_fem')[0]}")
            place = to_body_path(report.path.parent, int(contents.attributes["body"]))
            if not place.is_dir():
                return _add_skipped(report, "frames solved again: its body is not next to it")
            frames, found = _solve_again(contents.attributes, open_body(place, device), contents.fem_frames, count)
            stored = read_numbers(file, contents, "tumour_fem")[frames]
            rest = read_numbers(file, contents, "tumour_rest")
    except InputError as error:
        words = f"frames cannot be solved again: {format_finding(error, report.path)}"
        return replace(report, problems=[*report.problems, words])
    off = 1e3 * np.linalg.norm(rest + found - stored, axis=2).max(axis=1)
    allowed = LIVE_TOLERANCE_MM if contents.attributes.get("deformer") == "fem" else TRAINING_TOLERANCE_MM
    wrong = [f"frame {frame}, solved again: {far:.3f} mm error." for frame, far in zip(frames, off, strict=True)]
    broken = [words for words, far in zip(wrong, off, strict=True) if not far <= allowed]
    return replace(report, problems=[*report.problems, *broken], again_mm=float(off.max()), again=len(frames))


def _add_skipped(report: Report, reason: str) -> Report:
    return replace(report, skipped=[*report.skipped, reason])


def _solve_again(
    attributes: Mapping[str, Any], opened_body: OpenedBody, solved: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Solve frames again; return frame numbers (k,), and displacements (k, n, 3) [m] of the tumour's vertices."""
    plan = parse_plan(str(attributes["plan"]), str(attributes.get("plan_name", "plan")), Path())
    seed, number = int(attributes["seed"]), int(attributes["episode"])
    body, patient = opened_body.body, opened_body.patient
    scene = build_scene(plan, body, patient.site, sample_episode(plan.contents, seed, number), seed, number)
    fem = build_reference_fem(patient, scene)
    rows = np.unique(np.linspace(0, len(solved) - 1, min(count, len(solved))).astype(int))
    asked = np.arange(rows[-1] + 1) if is_history_dependent(fem) else rows
    loads = [scene.build_loads(patient.site, scene.path(time), time) for time in map(float, scene.times[solved[asked]])]
    result = solve_reference_frames(patient, scene, loads, fem=fem).restrict(patient.anatomy.tumour_nodes)
    return solved[rows], result.displacement[np.searchsorted(asked, rows)]


def validate_files(
    paths: Sequence[Path], workers: int, validate: Callable[[Path], Report] = validate_episode
) -> Iterator[Report]:
    """Yield a report for each file, in order of completion, with `workers` parallel processes.

    After a crash of a process, each remaining file is checked in its own process.
    """
    left = list(dict.fromkeys(paths))
    look_at = partial(_run_limited, validate)
    try:
        for path, report in map_parallel(look_at, tuple(left), workers):
            left.remove(path)
            yield report
    except LostProcessError:
        for path in left:
            try:
                yield from (report for _, report in map_parallel(look_at, [path]))
            except LostProcessError:
                yield Report(path, ["reading it crashes the process: it is damaged. Make it again, or leave it out."])


def _run_limited(validate: Callable[[Path], Report], path: Path) -> Report:
    find_device("cpu", "float32")  # keeps Warp's notes out of the report
    try:
        with limit_memory(MAX_MEMORY):
            return validate(path)
    except InputError as error:
        return Report(path, [str(error)])
