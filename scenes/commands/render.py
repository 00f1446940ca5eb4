"""`sulcus render`: write the frames of a scene as images, without display or browser."""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

from ar.screen import FrameFolder, read_png, write_movie
from sim.arguments import check_integer
from sim.errors import InputError
from sim.runtime.atomic_files import REMEDY, explain_error

from ..options.camera_options import add_camera_options, apply_camera_options
from ..options.outputs import add_force, check_output_folder, check_output_frames, check_output_path
from ..options.patient_options import add_patient, build_requested_scene, choose_deformer, open_patient
from ..options.shared_options import add_json, add_style


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument("scene", help="a built-in scene, see `sulcus scenes`, or MY_SCENE.py")
    parser.add_argument("--out", required=True, type=Path, help="folder of frame_0000.png, frame_0001.png, ...")
    parser.add_argument("--every", type=int, default=1, help="render every Nth frame")
    parser.add_argument("--film", type=Path, help="also write a video: .mp4, .gif or .webp")
    parser.add_argument("--plain", action="store_true", help="omit the panel of values")
    add_patient(parser)
    add_camera_options(parser)
    add_style(parser)
    add_force(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Render the frames of a scene to files; return 1 if the solution of a frame is unreliable, else 0."""
    from tqdm import tqdm

    from ..play.scene_costs import draw_cost_panel

    check_integer("--every", args.every, 1)
    check_output_folder(args.out, "frames")
    if args.film is not None:
        if args.film.suffix not in (".mp4", ".gif", ".webp"):
            raise InputError(f"{args.film}: unsupported video type: expected .mp4, .gif or .webp.")
        check_output_path(args.film, args.film.suffix, args.force, [args.camera])
    patient = open_patient(args, args.scene)
    scene = apply_camera_options(args, build_requested_scene(args, args.scene, patient))
    name = choose_deformer(args, patient, scene)
    player = replace(patient.build_player(name, scene), style=args.style)
    others = check_output_frames(args.out, args.force)
    written, bad = [], 0
    try:
        for path in others:
            path.unlink()
        film = FrameFolder(args.out)
        for frame in tqdm(player.play_frames(every=args.every), total=len(scene.times[:: args.every]), file=sys.stderr):
            film.show(frame.number, frame.shown if args.plain else draw_cost_panel(frame, name))
            written.append(args.out / f"frame_{frame.number:04d}.png")
            bad += not frame.deformation.outcome[0].good
        if args.film is not None:
            args.film.parent.mkdir(parents=True, exist_ok=True)
            write_movie(args.film, (read_png(path) for path in written), scene.frames_per_second / args.every)
    except OSError as error:
        raise InputError(f"{args.out}: the frames cannot be written ({explain_error(error)}). {REMEDY}") from error
    film, who = None if args.film is None else str(args.film), patient.describe_deformer(name, scene)
    report = {"scene": scene.name, "deformer": name, "solver": who, "frames": len(written), "not_good": bad}
    report |= {"out": str(args.out), "film": film}
    beside = "" if film is None else f", video {film}"
    unanswered = f"; solutions that did not converge or are extrapolated: {bad}" if bad else ""
    summary = f"{len(written)} frame{'s' * (len(written) != 1)} by {who}, written to {args.out}{beside}{unanswered}"
    print(json.dumps(report) if args.json else summary)
    return 1 if bad else 0
