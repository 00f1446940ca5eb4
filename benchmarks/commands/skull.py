"""`python -m benchmarks skull`: tumour motion with each skull model, on meshes of several sizes."""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from scenes.options.shared_options import add_device, add_json
from sim.arguments import check_integer
from sim.bodies.meshfile import read_anatomy
from sim.bodies.subject import MeshPlan, make_anatomy
from sim.bodies.template import Tumour, build_template_subject
from sim.effects import SKULLS
from surrogate.data.tool_loads import PRESETS, draw


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "anatomies", nargs="*", type=Path, metavar="ANATOMY.vtu", help="bodies (default: the template of --nodes)"
    )
    parser.add_argument("--nodes", nargs="+", type=int, default=[5300, 17_000, 40_000], help="nodes of the template")
    parser.add_argument(
        "--skulls", nargs="+", default=["bonded", "slide"], choices=(*SKULLS, "tearing", "pressing"),
        help="skull models (default: bonded slide). tearing: the bond fails above its strength. "
        "pressing: it bears nothing and has no gap",
    )  # fmt: skip
    parser.add_argument("--poisson", nargs="+", type=float, default=[0.45, 0.49], help="Poisson's ratios (0.45 0.49)")
    parser.add_argument("--preset", choices=PRESETS, default="palpation", help="tool preset")
    parser.add_argument("--loads", type=int, default=8, help="number of loads")
    add_device(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Measure, row by row; return 1 if a solve did not converge."""
    from scenes.analysis.measurement import describe_machine

    from ..studies.skull_models import measure_skulls

    check_integer("--loads", args.loads, 1)
    plans = [MeshPlan(count) for count in args.nodes]
    bodies = [read_anatomy(path) for path in args.anatomies]
    bodies = bodies or [make_anatomy(build_template_subject(Tumour()), plan) for plan in plans]
    loads = draw(args.preset, bodies[0], args.loads, 0)
    table = sys.stderr if args.json else sys.stdout
    where = describe_machine(args.device)
    print(f"{where}\n\n{len(loads)} {args.preset} loads\n", file=table)
    print("| skull | nu | vertices | tumour moves [mm] | leaks | bond bears | a load [s] |", file=table)
    print("|---|---|---|---|---|---|---|", file=table)
    found = []
    for row in measure_skulls(bodies, args.skulls, args.poisson, loads, args.device):
        found.append(row)
        moved = f"{row.motion:.4f}" + (f" ({row.failed} not converged)" if row.failed else "")
        bond = "" if row.bond is None else f"{row.bond:.2f}"
        leaked = "" if row.leaked is None else f"{row.leaked:.2g}"
        cells = (row.skull, f"{row.poisson:g}", row.vertices, moved, leaked, bond, f"{row.seconds:.2f}")
        print(f"| {' | '.join(map(str, cells))} |", file=table, flush=True)
    if args.json:
        print(json.dumps({"machine": where, "rows": [asdict(row) for row in found]}))
    return 1 if any(row.failed for row in found) else 0
