"""`sulcus effects`: what each effect of a scene costs and changes."""

import argparse
import json
import sys
from dataclasses import asdict

from sim.arguments import check_at_least

from ..options.shared_options import add_anatomy, add_device, add_json
from ..options.theatre_options import add_trajectory, build_requested_scene
from ..options.tissue_options import add_model_tissue

COLUMN_TITLES = (
    "effect",
    "ms a frame",
    "MB on the device",
    "tumour mm",
    "cortex mm",
    "",
)  # Column titles of the table.


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("scene", help="a built-in scene, see `sulcus scenes`, or MY_SCENE.py")
    parser.add_argument("--every", type=int, default=5, help="solve every Nth frame")
    add_anatomy(parser)
    add_trajectory(parser)
    add_model_tissue(parser)
    add_device(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Solve the scene with and without each."""
    from tqdm import tqdm

    from ..play.deformers import open_theatre
    from ..play.effect_ablation import measure_effects

    check_at_least("--every", args.every, 1)
    theatre = open_theatre(args.anatomy, device=args.device, scenes=[args.scene])
    scene = build_requested_scene(args, args.scene, theatre)
    table = sys.stderr if args.json else sys.stdout
    who = theatre.describe_deformer("fem", scene)
    print(f"{scene.name} by {who}: all effects together, then what each adds to the others\n", file=table)
    print(f"| {' | '.join(COLUMN_TITLES)} |\n|{'---|' * len(COLUMN_TITLES)}", file=table)
    found = []
    count = 1 + len(scene.get_effects_on(theatre.anatomy))
    with tqdm(total=count, unit="effect", leave=False, file=sys.stderr) as bar:
        for row in measure_effects(theatre, scene, args.every):
            found.append(row)
            figures = (row.milliseconds, row.held_mb, row.tumour_mm, row.cortex_mm)
            cells = ["" if figure is None else f"{figure:.2f}" for figure in figures]
            bar.write(f"| {' | '.join([row.effect, *cells, row.refused])} |", file=table)
            bar.update()
    if args.json:
        print(json.dumps({"scene": scene.name, "solver": who, "effects": [asdict(row) for row in found]}))
    return 0
