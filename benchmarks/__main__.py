"""Measurements of sulcus itself: `python -m benchmarks NAME ...`, from a checkout of the repository."""

import argparse
import importlib
import sys
from collections.abc import Sequence

from scenes.cli import join_points, limit_threads, run_command
from scenes.options.help import CommandParser

BENCHMARKS = {
    "stages": "cost of each stage of a frame on this machine",
    "elements": "error of each element against the limit of fine meshes, and its cost",
    "contact": "the mesh's share of a contact force: a ball is moved over one cell",
    "skull": "motion of the tumour under each skull, on meshes of several sizes, and what leaks",
    "robust": "convergence of thousands of random loads",
    "live": "duration and error of a frame of a moving tool, warm-started",
    "frame": "duration of each part of a page's frame: load, deform, render, composite, encode, send",
    "growth": "time and memory that a load takes on finer and finer meshes, and its preconditioner",
    "throughput": "loads a second that the finite elements solve: one mesh, thousands of loads",
    "locate": "share of a tumour's motion that is found from points on the open cortex, by sulcus and by rivals",
    "microscope": "error and duration of locating the tumour from pictures of two eyes",
    "gym": "steps a second of the Gymnasium environments, of states and of pictures",
    "fit": "errors of tissue and skull that are fitted to several frames of known patients",
    "track": "error of a tool's tip that a camera sees by its printed cube",
    "link": "time that an OpenIGTLink client waits for the answer to a pose",
    "shortcuts": "time that each shortcut of the solver saves on typical loads",
    "solver": "time of the first load on a mesh and of a further one, compared with other packages",
    "all": "every figure of the performance pages in one go: a record, its tables, and what got slower",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one measurement; return an exit code, as `sulcus` commands do."""
    if argv is None:
        limit_threads()
    arguments = join_points(sys.argv[1:] if argv is None else argv)
    args = make_parser(*arguments[:1]).parse_args(arguments)
    return run_command(args, "benchmarks")


def make_parser(*asked: str) -> argparse.ArgumentParser:
    """Build the parser of all measurements; only those in `asked` get their arguments."""
    parser = CommandParser(prog="python -m benchmarks", description=__doc__)
    names = parser.add_subparsers(dest="command", required=True, metavar="NAME")
    for name, text in BENCHMARKS.items():
        one = names.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        one.set_defaults(program=f"benchmarks {name}")
        if name in asked:
            importlib.import_module(f"benchmarks.commands.{name}").add_arguments(one)
    return parser


if __name__ == "__main__":
    sys.exit(main())
