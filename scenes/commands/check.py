"""`sulcus check`: play the built-in scenes blank and hold their figures to their bounds."""

from __future__ import annotations

import argparse
import json
import sys

from sim.errors import InputError

from .demo import add_theatre


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("scenes", nargs="*", help="which (default: all built-in scenes)")
    parser.add_argument("--every", type=int, default=10, help="check every so many frames (default %(default)s)")
    add_theatre(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON line")


def run(args: argparse.Namespace) -> int:
    """Check scene by scene. 1: a bound was not kept."""
    from ..check import measure
    from ..scene import SCENES, find_scene
    from ..theatre import open_theatre
    from ..truth import truth_of

    if args.every < 1:
        raise InputError(f"--every {args.every}: give a whole number from 1 up.")
    scenes = [find_scene(name) for name in args.scenes or SCENES]
    theatre = open_theatre(args.anatomy, args.model, args.device)
    name = args.deformer or theatre.best
    rows = []
    for scene in scenes:
        player = theatre.player(name, scene)
        frames = list(player.frames(args.every))
        figures = measure(player, player.camera, frames, truth_of(theatre, scene, [frame.loads for frame in frames]))
        broken = figures.broken(scene.bounds)
        rows.append({"scene": scene.name, "frames": len(frames), **figures.row(), "broken": broken})
        print(
            f"{scene.name:10s} {'FAILS' if broken else 'passes'}  overlap {figures.overlap:.4f}  "
            f"error {figures.error_mm:.3f} mm of {figures.motion_mm:.2f} mm  projection {figures.pixels:.1e} px",
            file=sys.stderr if args.json else sys.stdout,
        )
        for sentence in broken:
            print(f"{'':10s} {sentence}", file=sys.stderr if args.json else sys.stdout)
    passed = not any(row["broken"] for row in rows)
    if args.json:
        print(json.dumps({"deformer": name, "passed": passed, "scenes": rows}))
    return 0 if passed else 1
