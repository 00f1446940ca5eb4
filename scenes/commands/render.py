"""`sulcus render`: the frames of a scene as pictures, without display or browser."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from ar.screen import Film, read_png, write_film
from sim.errors import InputError
from sim.files import check_output

from .demo import add_theatre, deformer_name, scene_asked


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("scene", help="a built-in scene, see `sulcus scenes`, or MY_SCENE.py")
    parser.add_argument("--out", required=True, type=Path, help="folder of frame_0000.png, frame_0001.png, ...")
    parser.add_argument("--every", type=int, default=1, help="draw every so many frames (default %(default)s)")
    parser.add_argument("--film", type=Path, help="besides, a film: .mp4, .gif or .webp")
    parser.add_argument("--plain", action="store_true", help="without the panel of figures")
    add_theatre(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON line")


def run(args: argparse.Namespace) -> int:
    """Draw, frame by frame. 1: a frame was answered badly."""
    from tqdm import tqdm

    from ..play import labelled
    from ..theatre import open_theatre

    scene = scene_asked(args, args.scene)
    if args.every < 1:
        raise InputError(f"--every {args.every}: give a whole number from 1 up.")
    if args.out.exists() and not args.out.is_dir():
        raise InputError(f"{args.out}: is a file, but the frames need a folder. Choose another name.")
    if args.film is not None and args.film.suffix not in (".mp4", ".gif", ".webp"):
        raise InputError(f"{args.film}: films are written as .mp4, .gif or .webp; give a name that ends so.")
    theatre = open_theatre(args.anatomy, args.model, args.device)
    name = deformer_name(args, theatre, scene)
    player = theatre.player(name, scene)
    if args.film is not None:
        check_output(args.film, args.film.suffix)
    written, bad = [], 0
    try:
        film = Film(args.out)
        for frame in tqdm(player.frames(every=args.every), total=len(scene.times[:: args.every]), file=sys.stderr):
            film.show(frame.number, frame.shown if args.plain else labelled(frame, name))
            written.append(args.out / f"frame_{frame.number:04d}.png")
            bad += not frame.deformation.outcome[0].good
        if args.film is not None:
            write_film(args.film, (read_png(path) for path in written), scene.frames_per_second / args.every)
    except OSError as error:
        raise InputError(f"{args.out}: the frames cannot be written ({error}). Choose another folder.") from error
    who = theatre.described(name, scene)
    report = {
        "scene": scene.name,
        "deformer": name,
        "solver": who,
        "frames": len(written),
        "not_good": bad,
        "out": str(args.out),
    }
    print(json.dumps(report) if args.json else f"{len(written)} frames by {who} in {args.out}; {bad} not good")
    return 1 if bad else 0
