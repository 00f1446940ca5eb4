"""`python -m benchmarks growth`: time and memory of a load over mesh size, as a table and a plot."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from scenes.options.outputs import add_force, check_output_path
from scenes.options.shared_options import add_device, add_json
from sim.arguments import check_integer
from sim.elements import ELEMENTS, RECOMMENDED

if TYPE_CHECKING:
    from ..studies.scaling import ScalingRow

SIZES = (2000, 5300, 17_000, 50_000, 100_000, 200_000)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("--sizes", nargs="+", type=int, default=list(SIZES), metavar="N", help="nodes (default: six)")
    parser.add_argument("--batch", nargs="+", type=int, default=[1, 8], metavar="B", help="batch sizes (default: 1 8)")
    parser.add_argument("--element", choices=ELEMENTS, default=RECOMMENDED, help="finite element")
    add_device(parser)
    parser.add_argument(
        "--out", type=Path, default=Path("growth.png"), metavar="PLOT.png",
        help="plot; rows and meshes are stored next to it, and an unfinished run resumes",
    )  # fmt: skip
    add_force(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Measure, row by row; return 1 if a load did not converge."""
    from ar.screen import write_png
    from scenes.analysis.loglog_chart import draw_panels
    from scenes.analysis.measurement import describe_machine, write_table
    from sim.bodies.subject import MeshPlan
    from sim.runtime.device import find_device
    from sim.runtime.journal import open_journal

    from ..studies.scaling import MeshTrial, ScalingRow, build_panels, measure_meshes

    check_integer("--batch", min(args.batch), 1)
    for size in args.sizes:
        MeshPlan(size)
    find_device(args.device, "float32")
    where, record, kept = describe_machine(args.device), args.out.with_suffix(".csv"), args.out.with_suffix(".rows")
    for path, suffix in ((args.out, ".png"), (record, ".csv")):
        check_output_path(path, suffix, args.force, resumed=kept.exists())
    if args.force:
        kept.unlink(missing_ok=True)
    trial = MeshTrial(args.element, args.device, args.out.parent)
    stated = {"machine": where.split(";")[0], "device": args.device, "element": args.element}
    table = sys.stderr if args.json else sys.stdout
    print(where, file=table)
    with (
        open_journal(kept, stated) as journal,
        tqdm(total=len(args.sizes) * len(args.batch), unit="row", file=sys.stderr) as bar,
    ):
        found = [row for row in journal.read_rows(ScalingRow) if row.size in args.sizes and row.asked in args.batch]
        bar.update(len(found))
        for row in measure_meshes(trial, args.sizes, args.batch, tuple(found), bar.set_description):
            journal.append(row)
            found.append(row)
            bar.update()
    found.sort(key=lambda row: (row.nodes, row.batch))
    write_table(record, [asdict(row) for row in found])
    write_png(args.out, draw_panels(build_panels(found)))
    _print(found, table)
    print(f"\n{args.out}: written; its rows are in {record}, its meshes beside it", file=table)
    if args.json:
        print(json.dumps({"machine": where, "rows": [asdict(row) for row in found], "plot": str(args.out)}))
    return 0 if all(row.converged == row.loads for row in found) else 1


def _print(found: Sequence[ScalingRow], table) -> None:
    names = (
        "nodes", "tetrahedra", "preconditioner", "set-up [s]", "batch", "a load [s]", "outer", "converged",
        "host [GiB]", "card [GiB]", "card, foreseen [GiB]",
    )  # fmt: skip
    print(f"\n| {' | '.join(names)} |\n|{'---|' * len(names)}", file=table)
    for row in found:
        cells = (
            row.nodes, row.tets, row.preconditioner, f"{row.set_up:.3g}", row.batch, f"{row.load:.3g}",
            f"{row.outer:g}", f"{row.converged} of {row.loads}", f"{row.memory:.3g}",
            *(f"{number:.3g}" if row.foreseen else "" for number in (row.card, row.foreseen)),  # None without a GPU
        )  # fmt: skip
        print(f"| {' | '.join(map(str, cells))} |", file=table)
