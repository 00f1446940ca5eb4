"""`python -m benchmarks solver`: time of the first and of a further load, compared with other FEM packages."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from scenes.options.shared_options import add_json, add_seed, to_json_line
from scenes.script.shipped_files import get_template_path
from sim.arguments import check_integer
from sim.bodies.meshfile import read_anatomy
from sim.errors import InputError

if TYPE_CHECKING:
    from ..peers.comparison import EngineRow

NAMES = ("tled", "modified-newton", "torch-fem", "scikit-fem", "felupe")
COLUMNS = (
    "engine",
    "tolerance",
    "first [s]",
    "/ ours",
    "further [s]",
    "/ ours",
    "converged",
    "residual",
    "off the reference [mm]",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "--peers", nargs="*", choices=NAMES, help="other packages to compare, or all (most need the extra `peers`)"
    )
    parser.add_argument(
        "--tolerance",
        nargs="+",
        type=float,
        default=[1e-6],
        help="required relative residuals, each in a separate run (default: 1e-6)",
    )
    parser.add_argument(
        "--device", choices=("cpu", "cuda"), default="cpu", help="device of sulcus and of tled; others use the CPU"
    )
    parser.add_argument(
        "--mesh", nargs="+", type=Path, metavar="MESH.vtu", help="made by `sulcus anatomy` (default: the template)"
    )
    parser.add_argument("--loads", type=int, default=20, help="palpation loads, each undeformed at first")
    add_seed(parser)
    parser.add_argument("--starts", type=int, default=3, help="number of first results of each package")
    parser.add_argument("--threads", type=int, default=2, help="threads of each package")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Compare; return 1 if a solution of sulcus is not within the tolerance."""
    from scenes.analysis.measurement import describe_machine
    from sim.runtime.device import find_device

    from ..peers.comparison import LEAST, OWN, PEERS, build_case, build_reference_solver, compare_engines

    for name, value, least in (
        ("--loads", args.loads, 2),
        ("--starts", args.starts, 1),
        ("--threads", args.threads, 1),
    ):
        check_integer(name, value, least)
    if wrong := [tolerance for tolerance in args.tolerance if not LEAST <= tolerance < 1.0]:
        raise InputError(f"--tolerance {wrong[0]:g} cannot be judged: give numbers from {LEAST:g} to below 1.")
    find_device(args.device, "float64")
    asked = () if args.peers is None else args.peers or NAMES
    engines = [engine.select_device(args.device) for engine in (OWN, *(peer for peer in PEERS if peer.name in asked))]
    cases = [build_case(read_anatomy(path), args.loads, args.seed) for path in args.mesh or [get_template_path()]]
    table = sys.stderr if args.json else sys.stdout
    where = describe_machine(args.device)
    print(
        f"{where}\n\nLog neo-Hookean, E 3 kPa, nu 0.45, linear tetrahedra, skull nodes held (not sliding: not every "
        f"peer can). {args.loads} palpation loads as nodal forces, each from rest and alone. One routine measures all "
        f"residuals, and distances from our answers to 1e-11. {args.threads} threads; imports not counted, compiled "
        "code in its cache.",
        file=table,
    )
    found, each = [], args.starts + args.loads
    for case in cases:
        started = sum(not engine.missing_reason for engine in engines)
        size = {"nodes": len(case.nodes), "tets": len(case.tets)}
        print(f"\n{size['nodes']} nodes, {size['tets']} tetrahedra\n\n| {' | '.join(COLUMNS)} |", file=table)
        print(f"|{'---|' * len(COLUMNS)}", file=table, flush=True)
        judge = build_reference_solver(case)
        with tqdm(total=len(args.tolerance) * started * each, unit="answer", file=sys.stderr) as bar:
            for tolerance in args.tolerance:
                to_this = replace(case, tolerance=tolerance)
                rows = compare_engines(to_this, judge, engines, args.starts, args.threads, bar.update)
                _print(rows, table)
                found.append({**size, "tolerance": tolerance, "rows": [_plain(row) for row in rows]})
    if args.json:
        print(to_json_line({"machine": where, "threads": args.threads, "meshes": found}))
    return 0 if all(answer["good"] for mesh in found for answer in mesh["rows"][0]["answers"]) else 1


def _print(rows: Sequence[EngineRow], table: Any) -> None:
    for row in rows:
        if row.missing:
            print(f"| {row.engine} | {row.tolerance:g} | {row.missing} |{' |' * (len(COLUMNS) - 3)}", file=table)
            continue
        good = [answer for answer in row.answers if answer.good]
        bad = next((answer for answer in row.answers if not answer.good), None)
        why = f"; not converged: {bad.reason or f'residual {bad.residual:.1e}'}" if bad else ""
        cells = (
            f"{row.engine} ({row.setting})",
            f"{row.tolerance:g}",
            _figure(row.first, ".2f"),
            _figure(row.first_ratio, ".2f"),
            _figure(row.further, ".3f"),
            _figure(row.ratio, ".1f"),
            f"{len(good)} of {len(row.answers)}{why}",
            f"<= {max(answer.residual for answer in good):.0e}" if good else "",
            f"<= {max(answer.apart for answer in good):.1e}" if good else "",
        )
        print(f"| {' | '.join(cells)} |", file=table, flush=True)


def _figure(value: float, form: str) -> str:
    return format(value, form) if np.isfinite(value) else ""


def _plain(row: EngineRow) -> dict[str, Any]:
    answers = [{**asdict(answer), "good": answer.good} for answer in row.answers]
    return {**asdict(row), "first": row.first, "further": row.further, "answers": answers}
