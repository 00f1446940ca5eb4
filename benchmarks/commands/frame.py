"""`python -m benchmarks frame`: time of each stage of a frame of the page."""

import argparse
import json
import sys
from contextlib import redirect_stdout
from dataclasses import asdict, replace

from scenes.options.patient_options import add_patient, build_requested_scene, choose_deformer, open_patient
from scenes.options.shared_options import add_json
from sim.arguments import check_integer


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    from scenes.cli import add_plugin

    parser.add_argument("scene", nargs="?", default="press", help="a built-in scene")
    add_patient(parser)
    add_plugin(parser)
    parser.add_argument("--size", default="640x480", metavar="WxH", help="size of the image [pixel]")
    parser.add_argument("--frames", type=int, default=120, help="number of timed frames")
    parser.add_argument(
        "--batch",
        type=int,
        help="images rendered in one batch, to measure images per second (default: 64 on CUDA, else 4)",
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Play the scene on a page without clients, and print the times."""
    from tqdm import tqdm

    from scenes.analysis.measurement import describe_machine

    from ..studies.frame import measure_batch_rate, parse_image_size, summarise_stages, time_frames

    check_integer("--frames", args.frames, 1)
    if args.batch is not None:
        check_integer("--batch", args.batch, 1)
    width, height = parse_image_size(args.size)
    theatre = open_patient(args, args.scene)
    scene = build_requested_scene(args, args.scene, theatre)
    scene = replace(scene, viewpoint=replace(scene.viewpoint, width=width, height=height))
    name = choose_deformer(args, theatre, scene)
    player = theatre.build_player(name, scene)
    where = f"{describe_machine(args.device)}; {scene.name} by {name}, {width} x {height}"
    with redirect_stdout(sys.stderr):  # viser prints its address there
        frames = time_frames(player, args.frames)
        found = summarise_stages(list(tqdm(frames, "frames", args.frames, unit="frame", file=sys.stderr)))
    count = args.batch or (4 if player.stage.device == "cpu" else 64)
    rate = measure_batch_rate(player, count)
    if args.json:
        rows = [asdict(row) for row in found]
        print(json.dumps({"machine": where, "rows": rows, "batch": count, "pictures_per_second": rate}))
        return 0
    print(f"{where}\n\n| stage | frames | ms: median | p95 | mean |\n|---|---|---|---|---|")
    for row in found:
        print(f"| {row.stage} | {row.frames} | {row.median:.2f} | {row.p95:.2f} | {row.mean:.2f} |")
    print(f"\n{rate:.3g} pictures a second, {count} together, with depth and segmentation, none brought to the host")
    return 0
