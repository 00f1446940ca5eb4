"""`python -m benchmarks contact`: error of a contact force due to the mesh."""

import argparse
import sys
from dataclasses import asdict

import numpy as np

from scenes.options.shared_options import add_anatomy, add_device, add_json, to_json_line
from scenes.options.tissue_options import add_tissue_arguments, parse_tissue
from scenes.script.shipped_files import get_template_path
from sim.bodies.meshfile import read_anatomy
from sim.elements import ELEMENTS, RECOMMENDED
from sim.errors import InputError

COLUMNS = (
    *("element", "depth [mm]", "force [mN]", "over halved cells", "range over a cell", "sideways, most"),
    *("seconds", "seconds, halved"),
)
LEGEND = """
over halved cells: excess over the force with the cells at the opening halved, as a share. That one is itself too
  large by about a third of this.
range over a cell: the largest force less the smallest over five places along one edge, as a share of the mean.
sideways, most: the force across the surface's normal, as a share of that along it.
seconds: duration of all places together, on the mesh as it is, and with halved cells."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_anatomy(parser)
    parser.add_argument(
        "--elements",
        nargs="+",
        default=[RECOMMENDED],
        choices=ELEMENTS,
        help=f"finite elements to measure (default: {RECOMMENDED})",
    )
    parser.add_argument(
        "--depths", nargs="+", type=float, default=[1.0, 3.0], help="depths of the ball [mm] (default: 1 3)"
    )
    parser.add_argument("--ball", type=float, default=6.0, help="radius of the ball [mm]")
    add_tissue_arguments(parser)
    add_device(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Measure, row by row; return 1 if a solution is not good."""
    from scenes.analysis.measurement import describe_machine

    from ..studies.contact_mesh import measure_forces

    if min(*args.depths, args.ball) <= 0.0:
        raise InputError("--depths and --ball are lengths in mm: give numbers above 0.")
    table, where = sys.stderr if args.json else sys.stdout, describe_machine(args.device)
    anatomy, found = read_anatomy(args.anatomy or get_template_path()), []
    print(f"{where}\n\n| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}", file=table)
    depths = [depth / 1e3 for depth in args.depths]
    for row in measure_forces(anatomy, args.elements, depths, args.ball / 1e3, parse_tissue(args), args.device):
        force = f"{row.element} | {1e3 * row.depth:g} | {1e3 * row.along.mean():.1f}"
        shares = f"{row.relative_excess:+.1%} | {row.relative_range:.1%} | {(row.sideways / row.along).max():.1%}"
        print(f"| {force} | {shares} | {row.seconds:.1f} | {row.fine_seconds:.1f} |", file=table, flush=True)
        found.append(row)
    print(LEGEND, file=table)
    if args.json:
        lists = [{name: np.asarray(value).tolist() for name, value in asdict(row).items()} for row in found]
        print(to_json_line({"machine": where, "rows": lists}))
    return 0 if all(np.isfinite(row.along + row.fine).all() for row in found) else 1
