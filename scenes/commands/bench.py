"""`sulcus bench`: measurements, each with a word of its own."""

from __future__ import annotations

import argparse
import importlib

BENCHES = {
    "stages": "what each stage of a frame costs on this machine (also done without a word)",
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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the words and their arguments."""
    words = parser.add_subparsers(required=True, metavar="WORD")
    for name, text in BENCHES.items():
        bench = importlib.import_module(f"{__package__}.bench_{name}")
        word = words.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        bench.add_arguments(word)
        word.set_defaults(bench=bench.run)


def run(args: argparse.Namespace) -> int:
    """Measure."""
    return args.bench(args)
