"""Command-line options of a scene's camera and its motion."""

from __future__ import annotations

import argparse
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sim.errors import InputError

if TYPE_CHECKING:
    from ..script.scene import Scene

# Names of camera paths. Repeated here, so that a command's help does not import cameras.
PATHS = ("hand-held", "microscope", "orbit")
MAX_TILT = 75.0  # Largest tilt of the line of sight [deg].


def add_camera_options(parser: argparse.ArgumentParser, default: str | None = None) -> None:
    """Add the camera options of commands that draw a scene to a parser; `default` is the default camera path."""
    group = parser.add_argument_group("camera options; see docs/camera.md")
    group.add_argument(
        "--camera", type=Path, metavar="FILE.yaml",
        help="camera calibration in the format of OpenCV or ROS (default: ideal camera)",
    )  # fmt: skip
    group.add_argument(
        "--size", type=parse_size, metavar="WxH",
        help="scale the calibration of --camera to images of this size [pixel]",
    )  # fmt: skip
    group.add_argument(
        "--tilt", type=float, metavar="DEG",
        help="angle of the line of sight to the axis of the craniotomy (default: the most oblique view of the tumour "
        "through the craniotomy)",
    )  # fmt: skip
    group.add_argument(
        "--distance", type=float, metavar="MM",
        help="distance of the camera (default: 300; with --path tracked: all targets are visible)",
    )  # fmt: skip
    group.add_argument("--path", choices=PATHS, default=default, help=f"camera motion (default: {default or 'none'})")
    group.add_argument("--path-seed", type=int, default=0, help="seed of --path hand-held")
    group.add_argument("--eye", choices=("left", "right"), help="camera of a stereo pair that draws; baseline 24 mm")


def parse_size(text: str) -> tuple[int, int]:
    """Parse the text WxH into width and height [pixel], for argparse."""
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size such as 640x480 [pixel]")
    return int(found[1]), int(found[2])


def apply_camera_options(args: argparse.Namespace, scene: Scene) -> Scene:
    """Return the scene with the camera requested by `add_camera_options`; unchanged if no option is given.

    Raises
    ------
    InputError
        See `read_calibration` and `HandHeld`; a size without a calibration, or with another aspect ratio; a tilt
        outside -75 to 75 degrees; a distance outside 50 to 1000 mm.
    """
    from ..script.camera_paths import PATHS as MADE
    from ..tracked.calibration_file import read_calibration

    view = scene.viewpoint
    if args.camera is not None:
        calibration = read_calibration(args.camera)
        if args.size is not None:
            try:
                calibration = calibration.resize_calibration(*args.size, allow_scaling=True)
            except ValueError as error:
                raise InputError(f"{args.camera}: {error}") from error
        view = view.calibrate(calibration)
    elif args.size is not None:
        raise InputError("--size scales the calibration of --camera: give both, or neither.")
    if args.tilt is not None:
        if not -MAX_TILT <= args.tilt <= MAX_TILT:
            raise InputError(f"--tilt is {args.tilt:g}: give an angle from {-MAX_TILT:g} to {MAX_TILT:g} degrees.")
        view = replace(view, tilt=-math.radians(args.tilt))
    if args.distance is not None:
        if not 50.0 <= args.distance <= 1000.0:
            raise InputError(f"--distance is {args.distance:g}: give 50 to 1000 mm.")
        view = replace(view, distance=1e-3 * args.distance)
    if args.path is not None:
        view = replace(view, path=MADE[args.path](args.path_seed))
    if args.eye is not None:
        view = replace(view, eye=args.eye)
    return scene if view is scene.viewpoint else replace(scene, viewpoint=view)


def use_tracked_camera(args: argparse.Namespace, scene: Scene) -> Scene:
    """Return the scene with a tracked camera that sees the craniotomy, the reference and the tool's cube.

    Raises
    ------
    InputError
        See `apply_camera_options`; also if the camera zooms.
    """
    from ..tracked.filming import VIEW, scale_distance

    if args.path == "microscope":
        raise InputError("--path microscope zooms, and a tracked camera has one calibration: choose another path.")
    scene = apply_camera_options(args, replace(scene, viewpoint=VIEW))
    return scene if args.distance is not None else replace(scene, viewpoint=scale_distance(scene.viewpoint))
