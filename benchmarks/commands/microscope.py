"""`python -m benchmarks microscope`: error of a tumour position estimated from stereo images."""

import argparse
import json
from dataclasses import asdict, replace

from scenes.options.patient_options import add_patient, build_requested_scene, open_patient
from scenes.options.shared_options import add_json
from sim.arguments import check_integer

from .locate import show_progress

HEADS = (
    "seed", "frames", "refused", "points", "tumour moves by up to [mm]", "off: median", "95 %", "most", "removed [%]",
    "in the 95 % ellipsoid [%]", "95 % radius [mm]", "update [ms]: median", "95 %",
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--scene", default="microscope", help="scene with a stereo camera, or MY_SCENE.py")
    parser.add_argument("--seeds", type=int, default=5, help="number of seeds, from 0")
    parser.add_argument("--every", type=int, default=10, help="stride of the used frames")
    parser.add_argument("--cloud", action="store_true", help="observe a point cloud, without correspondences")
    parser.add_argument("--plain", action="store_true", help="render without vessels: the scan's grey values alone")
    add_patient(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Measure the errors for each seed, and print the table; return 0."""
    from scenes.script.observation_models import StereoObservation

    from ..studies.stereo_study import measure_scene

    check_integer("--seeds", args.seeds, 1)
    check_integer("--every", args.every, 1)
    theatre = open_patient(args, args.scene)
    scene = build_requested_scene(args, args.scene, theatre)
    if isinstance(scene.observation_model, StereoObservation):
        model = replace(scene.observation_model, named=not args.cloud, vessels=not args.plain)
        scene = replace(scene, observation_model=model)
    with show_progress("estimates") as heard:
        found = list(measure_scene(theatre, scene, range(args.seeds), args.every, heard))
    if args.json:
        print(json.dumps([asdict(row) for row in found]))
        return 0
    print("Drawn pictures, not filmed ones. Errors are those of the tumour's middle, beside finite elements.")
    print(f"| {' | '.join(HEADS)} |\n|{'---|' * len(HEADS)}")
    for row in found:
        cells = (row.moved_mm, row.off_mm, row.p95_mm, row.most_mm)
        shares = (100.0 * row.removed, 100.0 * row.covered)
        times = f"{row.radius_mm:.2f} | {row.milliseconds:.0f} | {row.slowest_ms:.0f}"
        print(f"| {'all' if row.seed < 0 else row.seed} | {row.frames} | {row.refused} | {row.points:.0f} ", end="")
        print(
            f"| {' | '.join(f'{each:.2f}' for each in cells)} | {' | '.join(f'{each:.0f}' for each in shares)} ", end=""
        )
        print(f"| {times} |")
    return 0
