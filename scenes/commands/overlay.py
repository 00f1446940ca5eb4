"""`sulcus overlay`: draw the tumour into a video or into live camera images."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sim.errors import InputError
from sim.runtime.atomic_files import REMEDY, explain_error

from ..options.outputs import add_force, check_output_path
from ..options.patient_options import add_model_options
from ..options.poses_options import add_pose_options, check_pose_options, open_external_tracker
from ..options.shared_options import (
    add_address,
    add_device,
    add_json,
    add_style,
    list_addresses,
    print_addresses,
    to_json_line,
)
from ..options.tissue_options import add_model_tissue, apply_tissue_options
from ..tracked.tracked_scene import REST, build_requested_deformer, build_tracked_scene
from .interrupt import run_until_signal

if TYPE_CHECKING:
    from ar.optics.calibration import Calibration

    from ..tracked.follower import Follower
    from ..tracked.overlay_painter import Painter
    from ..tracked.page import OverlayPage
    from ..tracked.run import Overlay

VIDEO_SUFFIXES = (".mp4", ".gif", ".webp")  # Endings of video file names.
HOST = "127.0.0.1"  # Address of the page: reachable from this machine only.
NO_COVARIANCE_WARNING = (  # Warning about a calibration without a covariance.
    "{} states no covariance of the camera: the error has no part of its calibration in it. Calibrate yours by `sulcus "
    "calibrate`."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument(
        "pictures", metavar="FILM|CAMERA", help="a video, a folder of PNG or JPEG images, or a camera number"
    )
    parser.add_argument("--camera", required=True, metavar="K.yaml", help="camera calibration from `sulcus calibrate`")
    parser.add_argument("--registration", required=True, metavar="R.json", help="registration from `sulcus register`")
    parser.add_argument("--tool", metavar="TOOL.json", help="tool with its marker cube (default: no tool)")
    add_model_options(parser)
    parser.add_argument(
        "--deformer", metavar="NAME",
        help="deformation model under the tool: a model of tool poses, guarded, fem or rest. rest: as in the "
        "scan (default: the best model that knows the tool, else rest)",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, metavar="FILM.mp4", help="video with overlay: .mp4, .gif or .webp")
    parser.add_argument(
        "--table", type=Path, metavar="ROWS.csv", help="CSV with one row per frame: state, position, error"
    )
    parser.add_argument(
        "--covered", type=Path, metavar="MASKS",
        help="video or folder of PNG masks, one per frame in order; non-black pixels occlude the overlay, such as "
        "a hand",
    )  # fmt: skip
    add_style(parser)
    parser.add_argument("--rate", type=float, default=30.0, help="frame rate of a folder of images [1/s]")
    parser.add_argument(
        "--live", action="store_true", help="process the video in real time: frames that arrive too fast are skipped"
    )
    parser.add_argument(
        "--truth", metavar="TRUTH.npz", help="ground truth from `sulcus film`: reports the overlay error"
    )
    parser.add_argument(
        "--page", action="store_true", help="show the video in the browser; a live camera always has a page"
    )
    parser.add_argument("--port", type=int, default=8080, help="port of the page, or the next free one")
    add_address(parser)
    parser.add_argument(
        "--seconds", type=float, default=np.inf, help="close the page after this many seconds (default: never)"
    )
    add_pose_options(parser)
    add_model_tissue(parser, skull=True)
    add_device(parser, "FEM and images")
    add_json(parser)
    add_force(parser)


@dataclass(frozen=True, eq=False)
class Pipeline:
    """Tracker, renderer and camera of a run, and description of the deformation model."""

    calibration: Calibration
    follower: Follower
    painter: Painter
    model: str


def run(args: argparse.Namespace) -> int:
    """Draw the overlay on all images; return 0, or 1 if no image has a reliable tumour position.

    Raises
    ------
    InputError
        Files cannot be read or written, or do not belong together; images do not have the size of the calibration.
    """
    from ..tracked.run import write_tracking_table
    from ..tracked.truth import compute_overlay_error, read_truth, summarise_errors

    camera = args.pictures.isdecimal() and not Path(args.pictures).exists()
    if not 0.0 < args.rate < np.inf:
        raise InputError(f"--rate {args.rate:g}: frame rate [1/s] must be > 0.")
    if camera or args.page:
        return run_until_signal(partial(_serve_page, args, camera))
    inputs = [args.pictures, args.camera, args.registration, args.tool, args.anatomy, args.truth, args.covered]
    inputs += [*(args.poses or ()), args.hand_eye, args.camera_poses]
    check_pose_options(args)
    out = None if args.out is None else _check_video_path(args.out, args.force, inputs)
    table = None if args.table is None else check_output_path(args.table, ".csv", args.force, inputs)
    parts = _build_pipeline(args, is_video=True)
    stage = parts.painter.stage
    truth = None
    if args.truth is not None:
        truth = read_truth(args.truth, stage.anatomy.digest, len(stage.tumour_vertices))
    shown = _draw_video(args, parts, out)
    errors = [
        None if truth is None else compute_overlay_error(each.result, truth, parts.calibration, stage) for each in shown
    ]
    if table is not None:
        write_tracking_table(table, shown, errors)
    report = _summarise_run(shown, parts.model)
    if truth is not None:
        report["off"] = summarise_errors([each.result for each in shown], errors)
    return _print_summary(args, report, shown, out, table)


def _serve_page(args: argparse.Namespace, is_live: bool, exit_stack: ExitStack) -> int:
    """Show a video or a live camera on a page until the time is over or a signal arrives; return 0 or 1 as `run`."""
    from ar.page.access_guard import ViserError, check_address

    from ..tracked.run import write_tracking_table

    films = {"--out": args.out, "--truth": args.truth, "--covered": args.covered, "--poses": args.poses}
    given = [name for name, value in (films | {"--live": args.live or None}).items() if value is not None]
    if given:
        raise InputError(f"{', '.join(given)}: not supported with --page. Leave it out.")
    list_addresses(args)
    if not args.seconds > 0.0:
        raise InputError(f"--seconds {args.seconds:g}: give a positive number, or leave it out.")
    table = None if args.table is None else check_output_path(args.table, ".csv", args.force, [args.camera])
    try:
        check_address(HOST, args.port)
        parts = _build_pipeline(args, is_video=not is_live)
        shown = (_show_camera if is_live else _show_video)(args, parts, exit_stack)
    except (ValueError, OSError, ViserError) as error:
        raise InputError(str(error)) from error
    if table is not None:
        write_tracking_table(table, shown, [None] * len(shown))
    if not shown:
        return 1
    return _print_summary(args, _summarise_run(shown, parts.model), shown, None, table)


def _show_camera(args: argparse.Namespace, setup: Pipeline, exit_stack: ExitStack) -> list[Overlay]:
    from ar.tracking.live_camera import open_camera, read_camera_images, read_newest_images

    from ..tracked.follower import FollowerSettings

    again = partial(open_camera, int(args.pictures), setup.calibration.width, setup.calibration.height)
    name, source = f"camera {args.pictures}", again()
    if not source.isOpened():
        raise InputError(f"{name} cannot be opened: plug it in, see that no other program has it, and give its number.")
    images = read_newest_images(read_camera_images(source, name, again), FollowerSettings().max_gap)
    return _build_page(args, setup, exit_stack, name).watch(images, args.seconds)


def _show_video(args: argparse.Namespace, setup: Pipeline, exit_stack: ExitStack) -> list[Overlay]:
    from ..tracked.seekable_video import SeekableVideo

    film = SeekableVideo(Path(args.pictures), args.rate)
    return _build_page(args, setup, exit_stack, film.path.name, film.count).play(film, args.seconds)


def _build_page(args: argparse.Namespace, setup: Pipeline, stack: ExitStack, name: str, frames: int = 0) -> OverlayPage:
    from ..tracked.page import OverlayPage

    page = OverlayPage(setup.follower, setup.painter, name, setup.model, HOST, args.port, frames, list_addresses(args))
    stack.callback(page.close)
    print(f"sulcus: open {page.browser.address} (Ctrl-C ends); motion by {setup.model}", flush=True)
    print_addresses(page.browser)
    return page


def _print_summary(
    args: argparse.Namespace, report: dict[str, object], overlays: list[Overlay], out: Path | None, table: Path | None
) -> int:
    """Print the summary of a run; return 0, or 1 if no image has a reliable tumour position."""
    report |= {"out": None if out is None else str(out), "table": None if table is None else str(table)}
    print(to_json_line(report) if args.json else _format_report(report))
    return 0 if any(each.result.is_reliable for each in overlays) else 1


def _check_video_path(path: Path, force: bool, inputs: list[str | Path | None]) -> Path:
    if path.suffix not in VIDEO_SUFFIXES:
        raise InputError(f"{path}: unsupported video type: expected {', '.join(VIDEO_SUFFIXES)}.")
    return check_output_path(path, path.suffix, force, inputs)


def _build_pipeline(args: argparse.Namespace, is_video: bool) -> Pipeline:
    """Read the inputs of a run, small files first, and build its tracker and renderer."""
    from ar.overlay.composite import load_kernels
    from sim.accuracy import LIVE
    from sim.runtime.device import find_device

    from ..play.deformers import open_theatre
    from ..tracked.calibration_file import read_calibration, read_intrinsic_covariance
    from ..tracked.follower import Follower
    from ..tracked.overlay_painter import Painter
    from ..tracked.registration_file import describe_other_mesh, read_registration
    from ..tracked.tool_motion import ToolMotion
    from ..tracked.tracked_tool import read_tool
    from ..tracked.video_camera import check_video

    if args.tool is None and args.deformer not in (None, REST):
        raise InputError(f"--deformer {args.deformer} requires tool poses: give --tool TOOL.json, too.")
    for path in (args.anatomy, args.model, args.truth):
        if path is not None and not Path(path).is_file():
            raise InputError(f"{path}: no such file. See whether its name is right.")
    calibration, registration = read_calibration(args.camera), read_registration(args.registration)
    intrinsic = read_intrinsic_covariance(args.camera)
    if intrinsic is None:
        print(
            f"sulcus overlay: {NO_COVARIANCE_WARNING.format(Path(args.camera).with_suffix('.json'))}", file=sys.stderr
        )
    if is_video:
        check_video(Path(args.pictures), args.rate, calibration, args.camera)
    tool = None if args.tool is None else read_tool(args.tool)
    elsewhere = open_external_tracker(args, calibration)
    patient = open_theatre(args.anatomy, args.model, args.device)
    warning = describe_other_mesh(registration, patient.anatomy, args.registration)
    if warning:
        print(f"sulcus overlay: {warning}", file=sys.stderr)
    scene = apply_tissue_options(args, build_tracked_scene(args, None if tool is None else tool.shape), patient)
    stage = patient.build_stage(scene)
    deformer, who = build_requested_deformer(args, patient, scene, tool is not None)
    motion = ToolMotion(stage, deformer)
    device = find_device(args.device, LIVE.precision).name
    load_kernels(device)
    follower = Follower(calibration, registration, tool, motion, elsewhere, intrinsic)
    return Pipeline(calibration, follower, Painter(stage, tool, args.style, device), who)


def _draw_video(args: argparse.Namespace, setup: Pipeline, out: Path | None) -> list[Overlay]:
    """Draw the overlay on all images, and write a video if requested; return the overlays without images."""
    from ar.screen import write_movie
    from ar.tracking.image_sequences import read_frame_rate, read_video

    from ..tracked.run import draw_overlays, read_timed_images

    shown: list[Overlay] = []

    def draw_images() -> Iterator[np.ndarray]:
        masks = None if args.covered is None else read_video(args.covered, args.rate)
        film = read_timed_images(read_video(Path(args.pictures), args.rate, with_colour=True), masks)
        for each in draw_overlays(film, setup.follower, setup.painter, args.live):
            shown.append(each.drop_image())
            yield each.image

    try:
        if out is None:
            for _ in draw_images():
                pass
        else:
            write_movie(out, draw_images(), read_frame_rate(Path(args.pictures)) or args.rate)
    except ValueError as error:
        raise InputError(str(error)) from error
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({explain_error(error)}). {REMEDY}") from error
    return shown


def _summarise_run(overlays: list[Overlay], model: str) -> dict[str, object]:
    """Summarise a run for JSON: numbers of images, states, and latency; `model` describes the deformation model."""
    from ..tracked.run import summarise_latencies

    count = len(overlays)
    states = Counter(one.result.state.value for one in overlays)
    return {
        "pictures": count,
        "motion_by": model,
        "reference_seen_percent": 100.0 * sum(one.result.reference_time == one.result.time for one in overlays) / count,
        "tool_seen_percent": 100.0 * sum(one.result.T_scan_tool is not None for one in overlays) / count,
        "states": dict(states.most_common()),
        "latency": summarise_latencies(overlays),
    }


def _format_report(report: dict) -> str:
    """Format the summary of a run as text."""
    count, latency = report["pictures"], report["latency"]
    lines = [f"{count} images; motion by {report['motion_by']}"]
    lines += [f"  {100.0 * number / count:5.1f} %  {state}" for state, number in report["states"].items()]
    lines.append(f"{latency['what']}: {latency['p50_ms']:.0f} ms (median), {latency['p95_ms']:.0f} ms (95 %)")
    off = report.get("off")
    if off and off["pictures"]:
        lines += [
            f"error where the position is valid ({off['pictures']} images), median and 95th percentile:",
            f"  outline {off['outline_px_p50']:.1f}, {off['outline_px_p95']:.1f} px; overlap {off['overlap_p50']:.3f}",
            f"  centre {off['middle_mm_p50']:.2f}, {off['middle_mm_p95']:.2f} mm; maximum "
            f"{off['worst_mm_p50']:.2f}, {off['worst_mm_p95']:.2f} mm across the view",
            f"  error band {off['band_mm_p50']:.2f} mm: coverage {off['held_percent']:.0f} %; wrong: {off['wrong']}",
        ]
    lines += [f"written: {report[name]}" for name in ("out", "table") if report[name]]
    return "\n".join(lines)
