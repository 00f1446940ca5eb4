"""Measurements of sulcus itself: `python -m benchmarks NAME ...`, from a checkout of the repository."""

import argparse
import importlib
import sys
from collections.abc import Sequence

from scenes.cli import join_points, limit_threads, run_command
from scenes.options.help import CommandParser

BENCHMARKS = {
    "stages": "time of each stage of a frame on this machine",
    "elements": "error of each element relative to the limit of fine meshes, and its time",
    "contact": "error of a contact force due to the mesh: a ball moves over one cell",
    "skull": "motion of the tumour with each skull model, on meshes of several sizes, and leaked volume",
    "robust": "convergence of thousands of random loads",
    "live": "duration and error of a frame of a moving tool, warm-started",
    "frame": "duration of each part of a page's frame: load, deform, render, composite, encode, send",
    "growth": "time, memory and preconditioner of a load over mesh size",
    "throughput": "loads per second that FEM solves: one mesh, thousands of loads",
    "locate": "share of a tumour's motion that sulcus and baselines estimate from points on the open cortex",
    "microscope": "error and time of a tumour position estimated from stereo images",
    "gym": "steps per second of the Gymnasium environments, with states and with images",
    "fit": "errors of tissue and skull fitted to several frames of synthetic patients",
    "track": "error of a tool's tip that a camera tracks by its printed cube",
    "phantom": "motion of the lesion of a silicone brain phantom, measured by CT and predicted by FEM",
    "link": "latency from a pose to its result at an OpenIGTLink client",
    "shortcuts": "speed-up by each acceleration of the solver on typical loads",
    "solver": "time of the first load on a mesh and of a further one, compared with other packages",
    "all": "all figures of the performance pages: a record, its tables, and numbers that got worse",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one measurement; return an exit code, as `sulcus` commands do."""
    if argv is None:
        limit_threads()
    arguments = join_points(sys.argv[1:] if argv is None else argv)
    args = make_parser(*arguments[:1]).parse_args(arguments)
    return run_command(args, "benchmarks")


def make_parser(*selected: str) -> argparse.ArgumentParser:
    """Build the parser of all measurements; only those in `selected` get their arguments."""
    parser = CommandParser(prog="python -m benchmarks", description=__doc__)
    names = parser.add_subparsers(dest="command", required=True, metavar="NAME")
    for name, text in BENCHMARKS.items():
        one = names.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        one.set_defaults(program=f"benchmarks {name}")
        if name in selected:
            importlib.import_module(f"benchmarks.commands.{name}").add_arguments(one)
    return parser


if __name__ == "__main__":
    sys.exit(main())
