"""`sulcus calibrate`: calibrate a camera (board), a tool tip (pivoting), or two tracked bodies (hand-eye)."""

import argparse
import warnings
from collections.abc import Callable
from contextlib import suppress
from itertools import islice, product
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from sim.errors import InputError

from ..options.camera_options import parse_size
from ..options.outputs import add_force, check_output_path
from ..options.shared_options import add_json, to_json_line

if TYPE_CHECKING:
    from ar.tracking.tracker_calibration import HandEye, Pivot

Found = TypeVar("Found", "Pivot", "HandEye")
MAX_VIEWS = 40  # Maximum number of views used.
MIN_COVER = 0.6  # Share of the image area that corners should cover.
TIME_TOLERANCE = 1e-3  # Largest difference of the times in two files of poses [s].
MIN_MOTION = 1e-3  # Motion along each axis below which positions may be in metres by mistake [m].


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument(
        "pictures", nargs="?", type=Path, metavar="VIDEO|FOLDER",
        help="images of the board that `sulcus markers` prints: a video, or a folder of PNG or JPEG images",
    )  # fmt: skip
    parser.add_argument(
        "--pivot", type=Path, metavar="POSES.csv",
        help="estimate a tool's tip from poses around a fixed tip; columns as below",
    )  # fmt: skip
    parser.add_argument(
        "--hand-eye", type=Path, nargs=2, metavar=("A.csv", "B.csv"),
        help="estimate the transform from body B to body A from simultaneous poses of both; columns as below",
    )  # fmt: skip
    parser.add_argument(
        "--out", metavar="K.yaml", help="calibration to write; its covariance goes to K.json next to it"
    )
    parser.add_argument("--size", metavar="WxH", help="reject images of any other size, such as 1280x960")
    add_json(parser, "print one JSON line, with covariances, in place of words")
    add_force(parser)


def run(args: argparse.Namespace) -> int:
    """Calibrate a camera, a tool tip or a hand-eye transform, and report the result; return 0.

    Raises
    ------
    InputError
        There is not exactly one kind of input, files cannot be read or written, or the data do not determine the
        result.
    """
    asked = [each for each in (args.pictures, args.pivot, args.hand_eye) if each is not None]
    if len(asked) != 1:
        raise InputError("give a video or a folder of images, --pivot POSES.csv, or --hand-eye A.csv B.csv.")
    if args.pictures is not None:
        return _calibrate_camera(args)
    if args.out or args.size:
        raise InputError("--out and --size require images of the board: leave them out, and use --json.")
    return _calibrate_tip(args) if args.pivot is not None else _calibrate_hand_eye(args)


def _calibrate_camera(args: argparse.Namespace) -> int:
    """Calibrate a camera from images of the board, and write its files; return 0."""
    from ar.tracking.intrinsics import calibrate_intrinsics, choose_views
    from ar.tracking.targets import build_calibration_board

    from ..tracked.board_views import detect_board
    from ..tracked.calibration_file import SUFFIXES, build_intrinsics_header, write_calibration

    if not args.out:
        raise InputError("give --out K.yaml for the camera.")
    suffix = Path(args.out).suffix
    out = check_output_path(args.out, suffix if suffix in SUFFIXES else ".yaml", args.force, [args.pictures])
    table = check_output_path(out.with_suffix(".json"), ".json", args.force, [args.pictures])
    size = None if args.size is None else _parse_image_size(args.size)
    board = build_calibration_board()
    seen = detect_board(args.pictures, board, size)
    try:
        found = calibrate_intrinsics(
            choose_views(seen.views, board.faces[0], MAX_VIEWS),
            seen.width,
            seen.height,
            f"sulcus calibrate: {out.stem}",
        )
    except ValueError as error:
        raise InputError(f"{args.pictures}: {error}") from error
    report = {
        **build_intrinsics_header(found.calibration, found.covariance),
        "rms_px": found.rms,
        "pictures": str(args.pictures),
        "looked_at": seen.image_count,
        "seen": len(seen.views),
        "used": found.used_views,
        "left_out": found.excluded_views,
        "covered": found.covered_share,
    }
    write_calibration(out, found.calibration)
    _write_json(table, report)
    if args.json:
        print(to_json_line(report))
        return 0
    print(f"{seen.image_count} images, the board in {len(seen.views)}, {len(found.used_views)} views used")
    if found.excluded_views:
        print(f"held out because of a large residual: {', '.join(found.excluded_views)}")
    print(f"rms {found.rms:.3f} px; corners covered {100.0 * found.covered_share:.0f} % of the image")
    for name, value, deviation in zip(report["parameters"], found.parameters, found.deviations, strict=True):
        print(f"{name} {value:.6g} +- {deviation:.2g}{' px' if name[0] in 'fc' else ''}")
    if found.covered_share < MIN_COVER:
        print(f"Less than {100.0 * MIN_COVER:.0f} % is covered: the lens is not known well outside. Add views there.")
    print(f"written: {out}, with its covariance in {table}")
    return 0


def _write_json(path: Path, report: dict) -> None:
    from sim.runtime.atomic_files import write_atomically

    with write_atomically(path, ".json") as partial:
        partial.write_text(to_json_line(report) + "\n", encoding="utf-8")


def _parse_image_size(text: str) -> tuple[int, int]:
    """Parse the width and height of an image [pixel] from a text such as 1280x960."""
    try:
        return parse_size(text)
    except argparse.ArgumentTypeError as error:
        message = f"--size {text!r} is no size: give width and height [pixel], such as 1280x960."
        raise InputError(message) from error


def _calibrate_tip(args: argparse.Namespace) -> int:
    """Calibrate a tool's tip from poses of the tool pivoting about its tip, and print the result; return 0."""
    from ar.tracking.tracker_calibration import calibrate_pivot

    from ..tracked.pose_file import read_poses

    rows, _, poses = read_poses(args.pivot)
    found = _fit_poses(calibrate_pivot, [args.pivot], [poses], rows)
    deviations = 1e3 * np.sqrt(np.diag(found.covariance))
    if args.json:
        report = {
            "tip_mm": (1e3 * found.tip).tolist(),
            "centre_mm": (1e3 * found.centre).tolist(),
            "covariance_mm2": (1e6 * found.covariance).tolist(),
            "rms_mm": 1e3 * found.rms,
            "tilt_degrees": float(np.degrees(found.tilt)),
        }
        print(to_json_line(report))
        return 0
    print(f"tip in the tool's frame: {_format_values(1e3 * found.tip, deviations[:3])} mm")
    print(f"it stood at {_format_values(1e3 * found.centre, deviations[3:])} mm")
    print(
        f"rms {1e3 * found.rms:.3f} mm; all directions in the tool turned by {np.degrees(found.tilt):.0f} degrees (rms)"
    )
    return 0


def _format_values(values: np.ndarray, deviations: np.ndarray) -> str:
    return ", ".join(f"{value:.3f} +- {off:.2g}" for value, off in zip(values, deviations, strict=True))


def _fit_poses(fit: Callable[..., Found], files: list[Path], poses: list[np.ndarray], rows: np.ndarray) -> Found:
    """Fit a calibration to the poses of files with `fit`; raise InputError if this fails or residuals are too large."""
    from ar.tracking.rigid import list_conventions

    names = " and ".join(map(str, files))
    try:
        found = fit(*poses)
    except ValueError as error:
        raise InputError(f"{names}: {error}") from error
    for file, each in zip(files, poses, strict=True):
        moved = np.ptp(each[:, :3, 3], axis=0).max()
        if moved < MIN_MOTION:
            warnings.warn(f"{file}: positions move by only {1e3 * moved:.2g} mm: are they metres?", stacklevel=1)
    if not found.misfit:
        return found
    worst = int(found.distances.argmax())
    hint = "Leave out wrong rows, and"
    for forms in islice(product(*(list_conventions(each).items() for each in poses)), 1, None):  # the first is as read
        with suppress(ValueError):  # Poses of this form may turn too little.
            if not fit(*(form for _, form in forms)).misfit:
                fitting = [f"{how} in {file}" for file, (how, _) in zip(files, forms, strict=True) if how]
                hint = f"The quaternions fit {' and '.join(fitting)}:"
                break
    raise InputError(
        f"{names}: {found.misfit}. The largest residual is {1e3 * found.distances[worst]:.1f} mm, in row {rows[worst]} "
        f"of {files[0]}. {hint} give qx,qy,qz,qw from the body to its tracker."
    )


def _calibrate_hand_eye(args: argparse.Namespace) -> int:
    """Estimate the transform between two bodies from poses of both, and print the result; return 0."""
    from ar.tracking.tracker_calibration import solve_hand_eye

    from ..tracked.pose_file import read_poses

    one, other = args.hand_eye
    (rows, times, first), (_, again, second) = read_poses(one), read_poses(other)
    if len(times) != len(again) or np.abs(times - again).max(initial=0.0) > TIME_TOLERANCE:
        raise InputError(f"{one} and {other} have rows at different times: keep those that both have, in one order.")
    found = _fit_poses(solve_hand_eye, [one, other], [first, second], rows)
    if args.json:
        report = {
            "rotation": found.X[:3, :3].tolist(),
            "shift_mm": (1e3 * found.X[:3, 3]).tolist(),
            "rms_degrees": float(np.degrees(found.rotation_error)),
            "rms_mm": 1e3 * found.translation_error,
            "motions": found.motion_count,
            "spread_degrees": float(np.degrees(found.axis_spread)),
        }
        print(to_json_line(report))
        return 0
    print("X, where x_A = X x_B [mm]:")
    for row in found.X[:3] * [1.0, 1.0, 1.0, 1e3]:
        print("  " + "".join(f"{value:12.6f}" for value in row[:3]) + f"{row[3]:12.3f}")
    angle, distance = np.degrees(found.rotation_error), 1e3 * found.translation_error
    print(f"rms {angle:.3f} degrees and {distance:.3f} mm over {found.motion_count} motions")
    return 0
