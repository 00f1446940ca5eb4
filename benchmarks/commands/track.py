"""`python -m benchmarks track`: error of a tool's tip that a camera tracks by its printed cube."""

import argparse
import json
import sys
from dataclasses import asdict

from scenes.options.shared_options import add_json, add_seed
from sim.arguments import check_integer

from .locate import show_progress

HEADS = (
    "protocol", "pictures", "tip: median [mm]", "p95", "largest", "certain [%]", "wrong", "held at 95 % [%]", "ms",
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--pictures", type=int, default=60, help="number of images of each protocol")
    add_seed(parser, "poses and noise")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Measure; return 1 if a wrong pose was reported as certain."""
    from ..studies.track_study import measure_protocols

    check_integer("--pictures", args.pictures, 2)
    check_integer("--seed", args.seed, 0)
    with show_progress("pictures") as heard:
        rows = measure_protocols(args.pictures, args.seed, heard)
    if args.json:
        print(json.dumps([asdict(row) for row in rows]))
    else:
        print("Drawn pictures, not filmed ones: bent paper, motion blur and a wrong calibration come on top.")
        print(f"| {' | '.join(HEADS)} |\n|{'---|' * len(HEADS)}")
        for row in rows:
            cells = (row.median, row.p95, row.most)
            certain = "-" if row.certain is None else f"{row.certain:.0f}"
            shares = (certain, str(row.wrong), f"{row.held:.0f}", f"{row.milliseconds:.1f}")
            print(f"| {row.protocol} | {row.pictures} | {' | '.join(f'{each:.2f}' for each in cells)} ", end="")
            print(f"| {' | '.join(shares)} |")
    wrong = sum(row.wrong for row in rows)
    if wrong:
        print(f"benchmarks track: {wrong} wrong poses were called certain", file=sys.stderr)
    return 1 if wrong else 0
