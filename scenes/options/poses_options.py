"""Command-line options of an external tracker: pose files, time offset, and mounting of the camera."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sim.errors import InputError

if TYPE_CHECKING:
    from ar.optics.calibration import Calibration
    from ar.tracking.pose_stream import Clock, PoseStream

    from ..tracked.external_tracker import ExternalTracker

AUTO = "auto"  # Value of --clock that estimates the time offset.


def add_pose_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of an external tracker to a parser."""
    group = parser.add_argument_group("poses of an external tracker with its own clock; see docs/external_tracker.md")
    group.add_argument(
        "--poses", type=Path, nargs=2, metavar=("TOOL.csv", "PATIENT.csv"),
        help="poses of the tool and of the patient's reference in the tracker's frame, as `sulcus track` writes them",
    )  # fmt: skip
    group.add_argument(
        "--clock", nargs="+", metavar="SECONDS", default=["0"],
        help="tracker time minus image time [s], and its standard deviation (default: 0). auto: from the "
        "motion of a cube and a reference that the video also shows",
    )  # fmt: skip
    group.add_argument(
        "--hand-eye", type=Path, metavar="H.json",
        help="camera pose in the tracker's frame, from `sulcus calibrate --hand-eye --json` (default: from the "
        "printed reference in the video)",
    )  # fmt: skip
    group.add_argument(
        "--camera-poses", type=Path, metavar="CAMERA.csv",
        help="poses of the body that carries the camera; --hand-eye is then relative to that body",
    )  # fmt: skip


def check_pose_options(args: argparse.Namespace) -> None:
    """Check the options of an external tracker for conflicts, before files are read.

    Raises
    ------
    InputError
        An option is given without --poses, poses are given without a tool, or the clock is invalid.
    """
    if args.poses is None:
        if args.clock != ["0"] or args.hand_eye is not None or args.camera_poses is not None:
            raise InputError("--clock, --hand-eye and --camera-poses belong to another tracker: give --poses, too.")
        return
    if args.tool is None:
        raise InputError("--poses has the poses of a tool: give --tool TOOL.json, too.")
    if args.camera_poses is not None and args.hand_eye is None:
        raise InputError("--camera-poses has a body that the camera is fixed to: give --hand-eye H.json, too.")
    if args.clock != [AUTO]:
        _parse_clock(args.clock)


def _parse_clock(text: list[str]) -> tuple[float, float]:
    """Parse the time offset [s] and its standard deviation [s] from the words of --clock."""
    try:
        offset, error = float(text[0]), float(text[1]) if len(text) > 1 else 0.0
    except ValueError:
        offset, error = np.nan, np.nan
    if len(text) > 2 or not np.isfinite([offset, error]).all() or error < 0.0:
        raise InputError(f"--clock {' '.join(text)}: give seconds, and by how much they are off; or {AUTO}.")
    return offset, error


def open_external_tracker(args: argparse.Namespace, calibration: Calibration) -> ExternalTracker | None:
    """Read the requested external tracker with its poses; None without a request.

    Raises
    ------
    InputError
        A file cannot be read, or the time offset cannot be estimated.
    """
    from ..tracked.calibration_file import read_hand_eye
    from ..tracked.external_tracker import CameraMount, ExternalTracker
    from ..tracked.pose_file import read_pose_stream

    if args.poses is None:
        return None
    tool, patient = (read_pose_stream(path) for path in args.poses)
    eye = None
    if args.hand_eye is not None:
        body = None if args.camera_poses is None else read_pose_stream(args.camera_poses)
        eye = CameraMount(*read_hand_eye(args.hand_eye), body)
    elsewhere = ExternalTracker(tool, patient, _choose_clock(args, calibration, tool, patient), eye)
    _report_mismatch(args, elsewhere)
    return elsewhere


def _report_mismatch(args: argparse.Namespace, tracker: ExternalTracker) -> None:
    """Print the times of poses and video if the video begins outside the time range of the poses."""
    from ar.tracking.image_sequences import read_video

    from ..tracked.run import read_timed_images

    first = next(read_timed_images(read_video(Path(args.pictures), args.rate))).source.time
    outside = tracker.describe_mismatch(first)
    if not outside:
        return
    when = [
        f"the {name}'s poses of {each.times[0]:.2f} to {each.times[-1]:.2f} s"
        for name, each in tracker.pose_streams.items()
    ]
    clock = f"; --clock is {tracker.clock.offset:g} s" if tracker.clock.offset else ""
    message = f"{outside}. It is of {first:.2f} s, {', '.join(when)}{clock}. Give --clock S, or {AUTO}"
    print(f"sulcus overlay: {message}", file=sys.stderr)


def _choose_clock(args: argparse.Namespace, calibration: Calibration, tool: PoseStream, patient: PoseStream) -> Clock:
    """Return the time offset of --clock, or estimate it from the markers that the video shows."""
    from ar.tracking.image_sequences import read_video
    from ar.tracking.pose_stream import Clock

    from ..tracked.external_tracker import estimate_video_clock
    from ..tracked.run import read_timed_images

    if args.clock != [AUTO]:
        return Clock(*_parse_clock(args.clock))
    try:
        film = (each.source for each in read_timed_images(read_video(Path(args.pictures), args.rate)))
        found = estimate_video_clock(film, calibration, tool, patient)
    except ValueError as error:
        raise InputError(f"--clock {AUTO}: {error}") from error
    message = f"the tracker's clock runs {found.offset:.4f} s ahead of the video's, +- {found.error:.4f} s"
    print(f"sulcus overlay: {message}", file=sys.stderr)
    return found
