"""`sulcus collect`: record a scene as one episode in HDF5."""

import argparse
import json
import sys
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from ..options.camera_options import add_camera_options, apply_camera_options
from ..options.outputs import add_force, check_output_path
from ..options.patient_options import add_patient, build_requested_scene, choose_deformer, open_patient
from ..options.shared_options import add_json, add_style


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument("scene", help="a built-in scene, see `sulcus scenes`, or MY_SCENE.py")
    parser.add_argument("--out", required=True, type=Path, help="output episode file (.h5)")
    add_patient(parser)
    add_camera_options(parser)
    add_style(parser)
    add_force(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Play the scene, and write its episode to a file; return 0."""
    from tqdm import tqdm

    from ..episodes.episode import collect

    out = check_output_path(args.out, ".h5", args.force, [args.anatomy, args.camera])
    patient = open_patient(args, args.scene)
    scene = apply_camera_options(args, build_requested_scene(args, args.scene, patient))
    scene = replace(scene, look=replace(scene.look, natural=False))  # depth images show the FEM surface
    name = choose_deformer(args, patient, scene)
    player = replace(patient.build_player(name, scene), style=args.style)
    total = len(scene.times)
    with tqdm(total=2 * total, unit="frame", desc="drawn", file=sys.stderr) as bar:

        def drawn(frames: Iterable) -> Iterator:
            for frame in frames:
                yield frame
                bar.update()
            bar.set_description("finite elements")

        report = collect(out, patient, player, name, drawn, bar.update)
    summary = f"{report['frames']} frames by {name}, written to {out}; FEM: {report['fem']}"
    print(json.dumps(report) if args.json else summary)
    return 0
