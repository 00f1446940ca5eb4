"""`python -m benchmarks shortcuts`: speed-up by each acceleration of the solver on typical loads."""

import argparse
import json
import sys
from dataclasses import asdict

from scenes.options.shared_options import add_anatomy, add_device, add_json
from scenes.script.shipped_files import get_template_path
from sim.accuracy import LIVE
from sim.arguments import check_integer
from sim.bodies.meshfile import read_anatomy


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_anatomy(parser)
    parser.add_argument("--runs", type=int, default=20, help="number of loads or frames of each row")
    add_device(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Measure each acceleration, and print the table row by row."""
    from scenes.analysis.measurement import describe_machine
    from scenes.script.craniotomy_frame import build_craniotomy_frame
    from sim.runtime.device import find_device

    from ..studies.shortcuts import list_cases, measure_case

    check_integer("--runs", args.runs, 1)
    site = build_craniotomy_frame(read_anatomy(args.anatomy or get_template_path()))
    table, where = sys.stderr if args.json else sys.stdout, describe_machine(args.device)
    print(f"{where}\n\n| shortcut | work | runs | with: median, p95 [ms] | without | ratio | of totals |", file=table)
    print(f"|{'---|' * 7}", file=table)
    found = []
    for work in list_cases(site, args.runs, find_device(args.device, LIVE.precision).on_cuda):
        row = measure_case(work, site, args.device)
        if row is None:
            continue
        found.append(row)
        times = f"{row.median:.3g}, {row.p95:.3g} | {row.median_without:.3g}, {row.p95_without:.3g}"
        shares = f"{row.ratio:.2f} | {row.ratio_of_totals:.2f}"
        print(f"| {row.shortcut} | {row.work} | {row.runs} | {times} | {shares} |", file=table, flush=True)
    if args.json:
        rows = [{**asdict(row), "ratio": row.ratio, "ratio_of_totals": row.ratio_of_totals} for row in found]
        print(json.dumps({"machine": where, "rows": rows}))
    return 0
