"""`python -m benchmarks elements`: error of each element relative to the limit of fine meshes."""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from scenes.options.shared_options import add_device, add_json
from scenes.script.shipped_files import get_template_path
from sim.bodies.meshfile import read_anatomy
from sim.bodies.refine import refine
from sim.elements import ELEMENTS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "anatomies", nargs="*", type=Path, metavar="ANATOMY.vtu", help="bodies (default: the template that ships)"
    )
    parser.add_argument(
        "--coarse", action="store_true", help="skip the bodies with every edge halved, which take the longest"
    )
    parser.add_argument("--elements", nargs="+", default=list(ELEMENTS), choices=ELEMENTS, help="which (default: all)")
    parser.add_argument("--poisson", nargs="+", type=float, default=[0.30, 0.45, 0.49, 0.495], help="Poisson's ratios")
    parser.add_argument("--force", type=float, default=0.1, help="force on a 7 mm disc [N]")
    add_device(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Measure, row by row; return 1 if a solve did not converge."""
    from scenes.analysis.measurement import describe_machine

    from ..studies.elements import PressCase, extrapolate_motions, measure_motions

    bodies = [read_anatomy(path) for path in args.anatomies or [get_template_path()]]
    anatomies = bodies if args.coarse else [mesh for body in bodies for mesh in (body, refine(body))]
    table = sys.stderr if args.json else sys.stdout
    where = describe_machine(args.device)
    print(f"{where}\n\n| nu | element | vertices | tumour moves [mm] | set-up [s] | solve [s] | outer |", file=table)
    print("|---|---|---|---|---|---|---|", file=table)
    found = []
    for row in measure_motions(anatomies, args.elements, args.poisson, PressCase(force=args.force), args.device):
        found.append(row)
        moved = f"{row.motion:.4f}" if row.good else f"{row.motion:.4f} (not converged)"
        cost = f"{row.set_up:.1f} | {row.solve:.2f} | {row.outer}"
        print(f"| {row.poisson:g} | {row.element} | {row.vertices} | {moved} | {cost} |", file=table, flush=True)
    limit = extrapolate_motions(found)
    if limit:
        print("\n| nu | limit [mm] | of it, by element and vertices |\n|---|---|---|", file=table)
    for poisson, motion in sorted(limit.items()):
        shares = (f"{r.element} {r.vertices}: {r.motion / motion:.1%}" for r in found if r.poisson == poisson)
        print(f"| {poisson:g} | {motion:.4f} | {', '.join(shares)} |", file=table)
    if args.json:
        print(json.dumps({"machine": where, "rows": [asdict(row) for row in found], "limit_mm": limit}))
    return 0 if all(row.good for row in found) else 1
