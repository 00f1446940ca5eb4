"""`sulcus scenes`: list the built-in scenes with their effects, deformers and images."""

import argparse
import json
import sys
from pathlib import Path

from sim.errors import InputError
from sim.runtime.atomic_files import REMEDY, explain_error

from ..options.outputs import add_force, check_output_folder, check_output_path
from ..options.patient_options import list_playable
from ..options.shared_options import add_anatomy, add_device, add_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument("scenes", nargs="*", help="built-in scenes, or MY_SCENE.py (default: all built-in scenes)")
    parser.add_argument(
        "--out", type=Path, help="draw and time each scene: folder for SCENE.png, and for all in sheet.png"
    )
    add_anatomy(parser)
    add_device(parser, "finite elements")
    add_force(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """List the scenes, and draw their images if requested; return 0."""
    from tqdm import tqdm

    from ar.screen import write_png

    from ..play.deformers import open_theatre
    from ..play.scene_costs import render_thumbnail, tile_images
    from ..script.scene import SCENES, find_scene

    scenes = {scene.name: scene for scene in map(find_scene, args.scenes or SCENES)}
    if args.out is not None:
        check_output_folder(args.out, "pictures")
        for name in (*scenes, "sheet"):
            check_output_path(args.out / f"{name}.png", ".png", args.force)
    patient = open_theatre(args.anatomy, device=args.device)
    lines = sys.stderr if args.json else sys.stdout
    drawn = [] if args.out is None else [scene.name for scene in list_playable(args, patient, list(scenes.values()))]
    rows, pictures = [], {}
    drawing = tqdm(total=len(scenes), unit="scene", leave=False, disable=args.out is None, file=sys.stderr)
    with drawing as bar:
        for name, scene in scenes.items():
            names = [type(effect).__name__ for effect in scene.get_effects_on(patient.anatomy)]
            row = {
                "scene": name,
                "title": scene.title,
                "effects": names,
                "deformers": list(patient.list_deformers(scene)),
            }
            players = ", ".join(patient.list_deformers(scene))
            row["solver"] = solver = patient.describe_deformer("fem", scene)
            bar.write(f"{name}: {scene.title}\n  acting: {', '.join(names)}", file=lines)
            bar.write(f"  can be played by: {players}\n  fem: {solver}", file=lines)
            if name in drawn:
                usual = patient.select_default(scene)
                found = render_thumbnail(patient.build_player(usual, scene), usual)
                pictures[name] = found.image
                row |= {"milliseconds": found.milliseconds, "moved_mm": found.motion_mm, "played_by": usual}
                cost = f"{found.total_milliseconds:.0f} ms a frame by {usual}"
                bar.write(f"  {cost}; the tumour moves by up to {found.motion_mm:.2f} mm", file=lines)
            rows.append(row)
            bar.update()
    if args.out is not None:
        try:
            for name, picture in pictures.items():
                write_png(args.out / f"{name}.png", picture)
            write_png(args.out / "sheet.png", tile_images(list(pictures.values())))
        except OSError as error:
            raise InputError(
                f"{args.out}: the images could not be written ({explain_error(error)}). {REMEDY}"
            ) from error
    if args.json:
        print(json.dumps({"scenes": rows, "out": None if args.out is None else str(args.out)}))
    return 0
