"""`sulcus render`: the frames of a scene as images, without display or browser."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

from ar.screen import Film, read_png, write_film
from sim.arguments import at_least
from sim.errors import InputError
from sim.runtime.atomic_files import REMEDY, why

from ..options.camera_options import add_camera, filmed
from ..options.outputs import add_force, claimed, claimed_folder, claimed_frames
from ..options.shared_options import add_json, add_style
from ..options.theatre_options import add_theatre, deformer_name, scene_asked, theatre_asked


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("scene", help="a built-in scene, see `sulcus scenes`, or MY_SCENE.py")
    parser.add_argument("--out", required=True, type=Path, help="folder of frame_0000.png, frame_0001.png, ...")
    parser.add_argument("--every", type=int, default=1, help="render every Nth frame (default: %(default)s)")
    parser.add_argument("--film", type=Path, help="also write a video: .mp4, .gif or .webp")
    parser.add_argument("--plain", action="store_true", help="leave out the panel of figures")
    add_theatre(parser)
    add_camera(parser)
    add_style(parser)
    add_force(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Render frame by frame; return 1 if a frame is unreliable."""
    from tqdm import tqdm

    from ..play.scene_costs import labelled

    at_least("--every", args.every, 1)
    claimed_folder(args.out, "frames")
    if args.film is not None:
        if args.film.suffix not in (".mp4", ".gif", ".webp"):
            raise InputError(f"{args.film}: films are written as .mp4, .gif or .webp; give a name that ends so.")
        claimed(args.film, args.film.suffix, args.force, [args.camera])
    theatre = theatre_asked(args, args.scene)
    scene = filmed(args, scene_asked(args, args.scene, theatre))
    name = deformer_name(args, theatre, scene)
    player = replace(theatre.player(name, scene), style=args.style)
    others = claimed_frames(args.out, args.force)
    written, bad = [], 0
    try:
        for path in others:
            path.unlink()
        film = Film(args.out)
        for frame in tqdm(player.frames(every=args.every), total=len(scene.times[:: args.every]), file=sys.stderr):
            film.show(frame.number, frame.shown if args.plain else labelled(frame, name))
            written.append(args.out / f"frame_{frame.number:04d}.png")
            bad += not frame.deformation.outcome[0].good
        if args.film is not None:
            args.film.parent.mkdir(parents=True, exist_ok=True)
            write_film(args.film, (read_png(path) for path in written), scene.frames_per_second / args.every)
    except OSError as error:
        raise InputError(f"{args.out}: the frames cannot be written ({why(error)}). {REMEDY}") from error
    film, who = None if args.film is None else str(args.film), theatre.described(name, scene)
    report = {"scene": scene.name, "deformer": name, "solver": who, "frames": len(written), "not_good": bad}
    report |= {"out": str(args.out), "film": film}
    beside = "" if film is None else f", film {film}"
    unanswered = f"; answers that did not converge or are extrapolated: {bad}" if bad else ""
    said = f"{len(written)} frame{'s' * (len(written) != 1)} by {who}, written to {args.out}{beside}{unanswered}"
    print(json.dumps(report) if args.json else said)
    return 1 if bad else 0
