"""`sulcus film`: render a video of a scene by a tracked camera, with printed targets and ground truth."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sim.arguments import check_integer
from sim.errors import InputError
from sim.runtime.atomic_files import REMEDY, explain_error

from ..options.camera_options import add_camera_options, use_tracked_camera
from ..options.outputs import add_force, check_output_folder, check_output_frames, check_output_path
from ..options.patient_options import add_patient, build_requested_scene, choose_deformer, open_patient
from ..options.shared_options import add_json, add_seed, to_json_line

if TYPE_CHECKING:
    from ..play.deformers import PatientSetup
    from ..play.player import Player
    from ..script.scene import Scene
    from ..tracked.filming import Disturbance, VideoFrame

# Kinds of disturbances. Repeated here, so that `--help` does not import the renderer.
DISTURBANCES = ("reference", "tool", "bright", "smear", "gap")
# Files that are written next to the video.
WRITTEN_FILES = ("camera.yaml", "camera.json", "registration.json", "tool.json", "truth.npz", "truth.csv")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument("scene", help="a built-in scene with a tool, see `sulcus scenes`, or MY_SCENE.py")
    parser.add_argument(
        "--out", required=True, type=Path, metavar="DIR",
        help="output folder of film.mp4, camera.yaml and .json, registration.json, tool.json, truth.npz and truth.csv",
    )  # fmt: skip
    parser.add_argument("--every", type=int, default=1, help="record every Nth frame")
    parser.add_argument("--seconds", type=float, help="duration of the recorded part of the scene [s] (default: all)")
    parser.add_argument("--png", action="store_true", help="write lossless DIR/frames/*.png instead of film.mp4")
    parser.add_argument(
        "--blur", type=float, default=0.5, metavar="PX", help="standard deviation of the lens blur [pixel]"
    )
    parser.add_argument("--noise", type=float, default=2.0, help="standard deviation of the pixel noise, of 255")
    parser.add_argument(
        "--readout", type=float, metavar="MS",
        help="rolling-shutter readout time [ms] (default: the camera's)",
    )  # fmt: skip
    add_seed(parser, "noise and of --registered")
    parser.add_argument(
        "--trouble", type=parse_disturbance, action="append", default=[], metavar="KIND:FROM-TO",
        help=f"disturbance between two times [s]: {', '.join(DISTURBANCES)}; repeatable",
    )  # fmt: skip
    parser.add_argument(
        "--registered", type=float, nargs=2, default=(0.0, 0.0), metavar=("MM", "DEGREES"),
        help="standard deviations of the registration error at the craniotomy, per axis (default: 0 0)",
    )  # fmt: skip
    add_patient(parser)
    add_camera_options(parser)
    add_force(parser)
    add_json(parser)


def parse_disturbance(text: str) -> tuple[str, float, float]:
    """Parse the text KIND:FROM-TO into the kind of a disturbance and two times [s], for argparse."""
    found = re.fullmatch(r"(\w+):([\d.]+)-([\d.]+)", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form KIND:FROM-TO, such as tool:1.0-1.5")
    try:
        return found[1], float(found[2]), float(found[3])
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} has times that are no numbers") from None


def run(args: argparse.Namespace) -> int:
    """Render the video, and write it with its ground truth; return 0.

    Raises
    ------
    InputError
        Input cannot be read, output cannot be written, or a number is out of range.
    """
    from ..tracked.calibration_file import write_calibration, write_exact_intrinsics
    from ..tracked.filming import Artefacts, Disturbance, mount_targets, register_with_error, render_frames
    from ..tracked.registration_file import write_registration
    from ..tracked.tracked_tool import write_tool
    from ..tracked.truth import VideoGroundTruth, write_truth, write_truth_table

    check_integer("--every", args.every, 1)
    for name, value in (
        ("--blur", args.blur),
        ("--noise", args.noise),
        *(("--registered", x) for x in args.registered),
    ):
        if not 0.0 <= value < np.inf:
            raise InputError(f"{name} {value:g}: give a number that is not below 0.")
    shift, turn = args.registered
    taking = Artefacts(args.blur, args.noise, tuple(Disturbance(*each) for each in args.trouble), args.seed)
    patient = open_patient(args, args.scene)
    scene = _build_scene(args, patient)
    if all("gap" in taking.list_disturbances(time) for time in scene.times[:: args.every].tolist()):
        raise InputError("no image would be recorded: choose --seconds and --trouble that leave some.")
    _check_disturbances(taking.disturbances, scene.times[:: args.every])
    calibration = scene.viewpoint.calibration
    assert calibration is not None
    folder = check_output_folder(args.out, "video and its ground truth")
    paths = {name: check_output_path(folder / name, Path(name).suffix, args.force) for name in WRITTEN_FILES}
    player = patient.build_player(choose_deformer(args, patient, scene, "fem"), scene)
    mounts = mount_targets(player)
    shots: list[VideoFrame] = []
    film = _save_video(args, render_frames(player, mounts, taking, args.every), shots, player)
    write_calibration(paths["camera.yaml"], replace(calibration, name=f"sulcus film: {scene.name}"))
    write_exact_intrinsics(paths["camera.json"], calibration)
    write_registration(paths["registration.json"], register_with_error(player.site, mounts, shift, turn, args.seed))
    write_tool(paths["tool.json"], mounts.tool)
    truth = VideoGroundTruth(
        player.site.anatomy.digest,
        np.array([shot.time for shot in shots]),
        np.stack([shot.T_camera_scan for shot in shots]),
        np.stack([shot.T_scan_tool for shot in shots]),
        np.stack([shot.displacement for shot in shots]),
    )
    write_truth(paths["truth.npz"], truth)
    write_truth_table(paths["truth.csv"], truth, player.stage.tumour_at_rest.vertices)
    moved = 1e3 * float(np.linalg.norm(truth.displacement, axis=2).mean(axis=1).max())
    report = {"scene": scene.name, "frames": len(shots), "film": str(film), "tumour_moves_mm": moved}
    summary = f"{len(shots)} images of {scene.name}; maximum tumour displacement {moved:.2f} mm: {film}"
    print(to_json_line(report) if args.json else summary)
    return 0


def _check_disturbances(disturbances: Sequence[Disturbance], times: np.ndarray) -> None:
    """Raise InputError if a disturbance contains none of the frame `times` (F,) [s], and so would have no effect."""
    for each in disturbances:
        if not ((each.start <= times) & (times < each.end)).any():
            raise InputError(
                f"--trouble {each.kind}:{each.start:g}-{each.end:g} contains no image of this video, which ends at "
                f"{times[-1]:.2f} s: choose times within it, or a smaller --every."
            )


def _build_scene(args: argparse.Namespace, patient: PatientSetup) -> Scene:
    """Return the requested scene with a tracked camera, limited to the requested duration."""
    scene = use_tracked_camera(args, build_requested_scene(args, args.scene, patient))
    if args.readout is not None:
        view = scene.viewpoint
        assert view.calibration is not None
        try:
            calibration = replace(view.calibration, readout=1e-3 * args.readout)
        except ValueError as error:
            raise InputError(f"--readout {args.readout:g}: {error}") from error
        scene = replace(scene, viewpoint=replace(view, calibration=calibration))
    return scene if args.seconds is None else replace(scene, duration=min(args.seconds, scene.duration))


def _save_video(args: argparse.Namespace, video: Iterator[VideoFrame], shots: list[VideoFrame], player: Player) -> Path:
    """Write the video, and append each frame without its image to `shots`; return the path of the video or folder."""
    from tqdm import tqdm

    from ar.screen import FrameFolder, write_movie

    def record_frames() -> Iterator[np.ndarray]:
        total = len(range(0, len(player.scene.times), args.every))
        for shot in tqdm(video, total=total, unit="picture", file=sys.stderr):
            shots.append(replace(shot, image=shot.image[:0]))
            yield shot.image

    try:
        if not args.png:
            args.out.mkdir(parents=True, exist_ok=True)
            film = check_output_path(args.out / "film.mp4", ".mp4", args.force)
            write_movie(film, record_frames(), player.scene.frames_per_second / args.every)
            return film
        frames = check_output_folder(args.out / "frames", "pictures")
        for path in check_output_frames(frames, args.force):
            path.unlink()
        screen = FrameFolder(frames)
        for number, colour in enumerate(record_frames()):
            screen.show(number, colour)
        return frames
    except OSError as error:
        raise InputError(f"{args.out}: the video cannot be written ({explain_error(error)}). {REMEDY}") from error
    except ValueError as error:
        raise InputError(str(error)) from error
