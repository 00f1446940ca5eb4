"""`python -m benchmarks live`: duration and error of a frame of a moving tool."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from tqdm import tqdm

from scenes.options.shared_options import add_anatomy, add_device, add_json
from scenes.options.tissue_options import add_tissue_arguments, parse_elasticity
from scenes.script.shipped_files import get_template_path
from sim.arguments import check_integer
from sim.bodies.meshfile import read_anatomy
from sim.effects import build_push_effects
from sim.elements import ELEMENTS, RECOMMENDED
from sim.errors import InputError

if TYPE_CHECKING:
    from ..studies.live import RideStatistics

CHECKED = 20
"""Default number of frames that are compared with the converged solution."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_anatomy(parser)
    parser.add_argument("--frames", type=int, default=1000, help="frames of each tool")
    parser.add_argument(
        "--checked", type=int,
        help=f"frames compared with the converged solution (default: {CHECKED}, or all where there are fewer)",
    )  # fmt: skip
    add_tissue_arguments(parser)
    parser.add_argument("--element", choices=ELEMENTS, default=RECOMMENDED, help="finite element")
    add_device(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Play every tool; return 1 if a frame did not converge or its error exceeds the limit."""
    from scenes.analysis.budget import MAX_LIVE_ERROR
    from scenes.analysis.measurement import describe_machine
    from scenes.script.craniotomy_frame import build_craniotomy_frame
    from scenes.script.scene import find_scene

    from ..studies.live import RIDES, build_live_fem, build_loads, compute_errors, solve_frames, summarise_ride

    check_integer("--frames", args.frames, 1)
    checked = min(CHECKED, args.frames) if args.checked is None else args.checked
    if not 1 <= checked <= args.frames:
        raise InputError(
            f"--frames {args.frames} --checked {checked} measures nothing: give 1 <= --checked <= --frames."
        )
    site = build_craniotomy_frame(read_anatomy(args.anatomy or get_template_path()))
    scene = replace(
        find_scene("press"), effects=build_push_effects(site.anatomy, parse_elasticity(args, site.anatomy.mesh))
    )
    fem = build_live_fem(scene, site, args.device, args.element)
    found = []
    for ride in RIDES:
        loads = build_loads(ride, scene, site, args.frames)
        frames = list(tqdm(solve_frames(fem, loads), ride.name, args.frames, unit="frame", file=sys.stderr))
        sample = frames[:: args.frames // checked][:checked]
        found.append(summarise_ride(ride, frames, compute_errors(sample, scene, site, args.element)))
    where = f"{describe_machine(args.device)}; {len(site.anatomy.mesh.nodes)} nodes, {args.element}"
    if args.json:
        print(
            json.dumps(
                {"machine": where, "promised_mm": 1e3 * MAX_LIVE_ERROR, "rides": [asdict(item) for item in found]}
            )
        )
    else:
        _print(where, found)
    return 0 if all(item.good and item.error <= 1e3 * MAX_LIVE_ERROR for item in found) else 1


def _print(where: str, rides: Sequence[RideStatistics]) -> None:
    names = ("tool", "frames", "ms: median", "p95", "p99", "worst", "outer steps: mean", "most", "outcomes", "off [mm]")
    print(f"{where}\n\n| {' | '.join(names)} |\n|{'---|' * len(names)}")
    for item in rides:
        outcomes = ", ".join(f"{count} {name.lower()}" for name, count in item.outcomes.items())
        times = (f"{value:.3g}" for value in (item.median, item.p95, item.p99, item.worst))
        cells = (
            item.ride, item.frames, *times, f"{item.steps:.1f}", item.most_steps, outcomes,
            f"<= {item.error:.4f} of {item.checked}",
        )  # fmt: skip
        print(f"| {' | '.join(map(str, cells))} |")
