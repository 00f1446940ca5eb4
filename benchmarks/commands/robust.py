"""`python -m benchmarks robust`: share of thousands of random loads that converge."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from scenes.options.outputs import add_force, check_output_path
from scenes.options.shared_options import add_anatomy, add_device, add_json, add_seed
from scenes.options.tissue_options import add_tissue_arguments, parse_elasticity
from scenes.script.shipped_files import get_template_path
from sim.bodies.meshfile import read_anatomy
from sim.effects import build_push_effects
from sim.elements import ELEMENTS, RECOMMENDED
from sim.errors import InputError

if TYPE_CHECKING:
    from ..studies.robustness import SetStatistics


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_anatomy(parser)
    parser.add_argument("--count", type=int, default=10_000, help="number of loads, half of them brutal")
    add_seed(parser)
    add_tissue_arguments(parser)
    parser.add_argument("--element", choices=ELEMENTS, default=RECOMMENDED, help="finite element")
    parser.add_argument("--batch", type=int, default=64, help="loads solved together")
    add_device(parser)
    parser.add_argument("--out", type=Path, metavar="LOADS.csv", help="row for each load; an unfinished run resumes")
    add_force(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Solve all loads; return 1 if one did not converge."""
    from scenes.analysis.measurement import describe_machine, write_table
    from sim.runtime.journal import open_journal

    from ..studies.robustness import LoadRecord, SolverTrial, solve_loads, summarise_sets

    if args.count < 2 or args.batch < 1:
        raise InputError(f"--count {args.count} --batch {args.batch} tries nothing: give --count >= 2, --batch >= 1.")
    anatomy = read_anatomy(args.anatomy or get_template_path())
    effects = build_push_effects(anatomy, parse_elasticity(args, anatomy.mesh))
    trial = SolverTrial(anatomy, effects, args.element, args.device, args.batch)
    stated = {"anatomy": anatomy.digest, "effects": repr(effects), "element": args.element}
    stated |= {"count": str(args.count), "seed": str(args.seed)}
    kept = args.out and args.out.with_suffix(".rows")
    if kept:
        check_output_path(args.out, ".csv", args.force, resumed=kept.exists())
        if args.force:
            kept.unlink(missing_ok=True)
    with (
        open_journal(kept, stated) if kept else nullcontext() as journal,
        tqdm(total=args.count, unit="load", file=sys.stderr) as bar,
    ):
        found = journal.read_rows(LoadRecord) if journal is not None else []
        bar.update(len(found))
        for some in solve_loads(trial, args.count, args.seed, tuple(found)):
            found += some
            bar.update(len(some))
            if journal is not None:
                for record in some:
                    journal.append(record)
    if kept:
        write_table(args.out, [asdict(record) for record in found])
    sets = summarise_sets(found)
    where = describe_machine(args.device)
    if args.json:
        print(json.dumps({"machine": where, "sets": [asdict(item) for item in sets]}))
    else:
        _print(where, sets)
    return 0 if all(item.converged == item.loads for item in sets) else 1


def _print(where: str, sets: Sequence[SetStatistics]) -> None:
    names = ("set", "loads", "converged", "rescued", "outer: median", "p99", "ms a load", "float64 residual", "hardest")
    print(f"{where}\n\n| {' | '.join(names)} |\n|{'---|' * len(names)}")
    for item in sets:
        hard = item.hardest
        cells = (
            item.preset,
            item.loads,
            f"{item.converged} ({item.converged / item.loads:.2%})",
            item.rescued,
            f"{item.outer_median:g}",
            f"{item.outer_p99:g}",
            f"{item.milliseconds:.3g}",
            f"<= {item.double:.1e} of {item.checked}" if item.checked else "",
            f"{hard.force:.3g} N on {1e3 * hard.footprint:.3g} mm: {hard.outcome.lower()}, {hard.outer} outer",
        )
        print(f"| {' | '.join(map(str, cells))} |")
