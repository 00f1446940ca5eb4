"""`sulcus collect`: a scene as one episode in HDF5."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from sim.files import check_output

from .demo import add_theatre, deformer_name, scene_asked


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("scene", help="a built-in scene, see `sulcus scenes`, or MY_SCENE.py")
    parser.add_argument("--out", required=True, type=Path, help="the episode, .h5")
    add_theatre(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON line")


def run(args: argparse.Namespace) -> int:
    """Play and write."""
    from tqdm import tqdm

    from ..collect import collect
    from ..theatre import open_theatre

    scene = scene_asked(args, args.scene)
    theatre = open_theatre(args.anatomy, args.model, args.device)
    name = deformer_name(args, theatre, scene)
    player = theatre.player(name, scene)
    out = check_output(args.out, ".h5")
    report = collect(
        out, theatre, player, name, lambda frames: tqdm(frames, total=len(scene.times), unit="frame", file=sys.stderr)
    )
    print(json.dumps(report) if args.json else f"{report['frames']} frames by {name} in {out}; FEM: {report['fem']}")
    return 0
