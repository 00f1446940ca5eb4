"""`python -m benchmarks link`: latency from a pose to its result at an OpenIGTLink client."""

import argparse
import json
import os
from dataclasses import asdict

from scenes.options.shared_options import add_json
from sim.arguments import check_integer
from sim.errors import InputError

from .locate import show_progress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--points", type=int, default=5000, help="number of points of the sent surface")
    parser.add_argument("--rate", type=float, default=30.0, help="poses per second")
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of each run [s]")
    parser.add_argument("--runs", type=int, default=5, help="number of runs")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Measure the latency in several runs, and print the best and the median run; return 0."""
    from scenes.analysis.measurement import describe_machine

    from ..studies.link_latency import CLIENTS, measure_latency

    check_integer("--points", args.points, 3)
    check_integer("--runs", args.runs, 1)
    if not (0.0 < args.rate <= 1000.0 and 0.0 < args.seconds <= 3600.0):
        raise InputError("--rate and --seconds: give up to 1000 poses a second, and up to 3600 seconds, both above 0.")
    found = []
    with show_progress("runs") as heard:
        for number in range(args.runs):
            found.append(measure_latency(args.points, args.rate, args.seconds))
            heard(number + 1, args.runs)
    best = min(found, key=lambda each: each.p99)
    middle = sorted(found, key=lambda each: each.p99)[len(found) // 2]
    load = os.getloadavg()[0]
    where = (
        f"{describe_machine('cpu')}; {os.cpu_count()} cores, load {load:.1f}; {CLIENTS} clients, {args.points} points"
    )
    if args.json:
        print(json.dumps({"machine": where, "best": asdict(best), "middle": asdict(middle)}))
        return 0
    print(f"{where}, {args.rate:g} poses a second, {args.seconds:g} s.")
    print("From a pose's time stamp to when a client has its whole surface. No deformer's time is in it.")
    print("| run | median [ms] | p99 [ms] | largest [ms] | poses answered [%] |\n|---|---|---|---|---|")
    for name, each in (("best", best), ("middle", middle)):
        print(f"| {name} of {args.runs} | {each.median:.1f} | {each.p99:.1f} | {each.most:.1f} | {each.answered:.0f} |")
    return 0
