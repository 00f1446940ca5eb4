"""`sulcus track`: write poses of the tool or the patient's reference in every frame of a calibrated camera."""

import argparse
import time
from collections import Counter
from pathlib import Path

import numpy as np

from sim.errors import InputError

from ..options.outputs import add_force, check_output_path
from ..options.shared_options import add_json, to_json_line

BODIES = ("tool", "patient", "board", "camera")  # Tracked bodies.
FRAMES = ("camera", "patient", "board")  # Coordinate systems of written poses.


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument(
        "pictures",
        type=Path,
        metavar="VIDEO|FOLDER",
        help="a video, or a folder of PNG or JPEG images in order of name",
    )
    parser.add_argument("--camera", required=True, metavar="K.yaml", help="the camera, from `sulcus calibrate`")
    parser.add_argument("--out", required=True, metavar="POSES.csv", help="CSV with one pose per frame")
    parser.add_argument("--body", choices=BODIES, default="tool", help="tracked body")
    parser.add_argument(
        "--reference-frame", choices=FRAMES, default="camera",
        help="coordinate system of the poses; patient and board must be visible",
    )  # fmt: skip
    parser.add_argument(
        "--tip", type=float, nargs=3, metavar=("X", "Y", "Z"),
        help="the tool's tip in the frame of its cube [mm], from `sulcus calibrate --pivot` (default: 0 0 -150)",
    )  # fmt: skip
    parser.add_argument("--rate", type=float, default=30.0, help="frame rate of a folder of images [1/s]")
    add_json(parser)
    add_force(parser)


def run(args: argparse.Namespace) -> int:
    """Track the body in every frame, and write its poses; return 0, or 1 if no frame has a reliable pose.

    Raises
    ------
    InputError
        Images or the calibration cannot be read, images have another size or focal length than the calibration, the
        rate is not > 0, or the body is its own reference.
    """
    from ar.tracking.targets import TIP_DISTANCE

    from ..tracked.calibration_file import read_calibration
    from ..tracked.external_tracker import track_video
    from ..tracked.pose_file import write_poses
    from ..tracked.video_camera import check_video

    if not 0.0 < args.rate < np.inf:
        raise InputError(f"--rate {args.rate:g}: frame rate [1/s] must be > 0.")
    if args.body == args.reference_frame:
        raise InputError(
            f"the {args.body} is at rest in its own frame: choose --reference-frame camera, or another --body."
        )
    out = check_output_path(args.out, ".csv", args.force, [args.pictures, Path(args.camera)])
    tip = np.array([0.0, 0.0, -TIP_DISTANCE]) if args.tip is None else 1e-3 * np.array(args.tip)
    if not np.isfinite(tip).all():
        raise InputError("--tip has a number that is not finite: give three numbers in millimetres.")
    calibration = read_calibration(args.camera)
    check_video(args.pictures, args.rate, calibration, args.camera)
    begun = time.perf_counter()
    rows = list(track_video(args.pictures, calibration, args.body, args.reference_frame, args.rate))
    seconds = time.perf_counter() - begun
    write_poses(out, rows, tip)
    good = sum(row.pose is not None for row in rows)
    middle = 1e3 * float(np.median([row.seconds for row in rows]))
    if args.json:
        states = Counter(row.verdict.name.lower() for row in rows)
        report = {"out": str(out), "pictures": len(rows), "states": states, "ms": middle, "seconds": seconds}
        print(to_json_line(report))
    else:
        print(f"{len(rows)} images of the {args.body}, {middle:.1f} ms each (median):")
        for (lacks, verdict), count in Counter((row.missing_target, row.verdict) for row in rows).most_common():
            print(f"  {100.0 * count / len(rows):5.1f} %  {f'{lacks} ' if lacks else ''}{verdict.value}")
        print(f"written: {out}, in the {args.reference_frame}'s frame")
    return 0 if good else 1
