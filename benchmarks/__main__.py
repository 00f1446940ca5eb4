"""Measurements of sulcus itself: `python -m benchmarks NAME ...`, from a checkout of the repository."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence

from scenes.cli import carried_out, limit_threads, with_points

BENCHMARKS = {
    "stages": "what each stage of a frame costs on this machine",
    "elements": "how far each element is from the limit of fine meshes, and what it costs",
    "contact": "what share of a contact force is the mesh's: a ball is moved over one cell",
    "skull": "how far the tumour moves under each skull, on meshes of several sizes, and what passes",
    "robust": "how many of thousands of random loads converge",
    "live": "what a frame of a moving tool takes, warm-started, and how far off it is",
    "frame": "where the time of a page's frame goes: load, deform, render, composite, encode, send",
    "growth": "time and memory that a load takes on finer and finer meshes, and its preconditioner",
    "throughput": "how many loads a second the finite elements solve: one mesh, thousands of loads",
    "published": "how far the published learners are off, one force position left out at a time",
    "locate": "how much of a tumour's motion is found from points on the open cortex, by us and by rivals",
    "microscope": "how far off the tumour is that is located from pictures of two eyes, and how long that takes",
    "gym": "how many steps a second the Gymnasium environments make, of states and of pictures",
    "fit": "how rightly tissue and skull of known patients are found from several frames",
    "track": "how far off a tool's tip is that a camera sees by its printed cube",
    "link": "how long an OpenIGTLink client waits for the answer to a pose",
    "shortcuts": "how much time each shortcut of the solver saves on typical loads",
    "solver": "time of the first load on a mesh and of a further one, compared with other packages",
    "all": "every figure of the performance pages in one go: a record, its tables, and what got slower",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one measurement. Returns what `sulcus` commands return."""
    if argv is None:
        limit_threads()
    arguments = with_points(sys.argv[1:] if argv is None else argv)
    args = make_parser(*arguments[:1]).parse_args(arguments)
    return carried_out(args, "benchmarks")


def make_parser(*asked: str) -> argparse.ArgumentParser:
    """The parser of all measurements; those asked for know their arguments."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    names = parser.add_subparsers(dest="command", required=True, metavar="NAME")
    for name, text in BENCHMARKS.items():
        one = names.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        one.set_defaults(program=f"benchmarks {name}")
        if name in asked:
            importlib.import_module(f"benchmarks.commands.{name}").add_arguments(one)
    return parser


if __name__ == "__main__":
    sys.exit(main())
