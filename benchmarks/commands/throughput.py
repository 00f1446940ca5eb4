"""`python -m benchmarks throughput`: loads per second that FEM solves."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from itertools import chain
from typing import TYPE_CHECKING

from tqdm import tqdm

from scenes.options.shared_options import add_anatomy, add_devices, add_json
from scenes.script.shipped_files import get_template_path
from sim.accuracy import TRAIN
from sim.arguments import check_integer
from sim.bodies.meshfile import read_anatomy
from sim.elements import ELEMENTS, RECOMMENDED
from sim.material import LAWS, Material
from surrogate.data.tool_loads import PRESETS

from ..figures.figure_tables import format_number

if TYPE_CHECKING:
    from sim.effects import Effect

    from ..studies.throughput import Drawn, ThroughputRow, ToolsRow

YOUNG = 3000.0
# Batch size on the CPU, where larger ones gain nothing; number of loads of a row on the CPU, and on CUDA.
CPU_BATCH, CPU_COUNT, CUDA_COUNT = 64, 64, 4096
NAMES = (
    "law", "nu", "element", "nodes", "set", "loads", "converged", "steps: median", "p99", "solves/s", "us a load",
    "draws/s", "float64 residual",
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_anatomy(parser)
    parser.add_argument(
        "--presets",
        nargs="+",
        choices=PRESETS,
        metavar="SET",
        help="presets of loads (default: all; with --poses the round tools)",
    )
    parser.add_argument("--poses", action="store_true", help="poses of each tool's ball, instead of forces")
    parser.add_argument(
        "--laws", nargs="+", choices=LAWS, default=["stable-neo-hookean", "neo-hookean"], metavar="LAW",
        help=f"laws with E = {YOUNG:g} Pa (default: stable-neo-hookean neo-hookean)",
    )  # fmt: skip
    parser.add_argument(
        "--poisson", nargs="+", type=float, default=[0.45, 0.49], metavar="NU", help="Poisson's ratios (0.45 0.49)"
    )
    parser.add_argument("--element", choices=ELEMENTS, default=RECOMMENDED, help="finite element")
    parser.add_argument(
        "--count", type=int, help=f"loads a row and device (default: {CUDA_COUNT} on CUDA, {CPU_COUNT} on the CPU)"
    )
    parser.add_argument("--batch", type=int, help=f"loads solved together (default: all; {CPU_BATCH} on the CPU)")
    parser.add_argument("--repeats", type=int, default=3, help="repeats of each row; the median is reported")
    add_devices(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Measure, row by row; return 1 if a load did not converge."""
    from scenes.analysis.measurement import describe_machine
    from sim.effects import ToolContact
    from sim.runtime.device import parse_device_names
    from surrogate.data.tool_poses import BALL_PRESETS, choose_ball

    from ..studies.robustness import SolverTrial
    from ..studies.throughput import combine_rows, measure_rates, sample_loads

    devices = parse_device_names(args.device)
    on_cuda = devices[0].startswith("cuda")
    count = args.count if args.count is not None else (CUDA_COUNT if on_cuda else CPU_COUNT)
    batch = args.batch if args.batch is not None else (count if on_cuda else CPU_BATCH)
    for name, value in (("--count", count), ("--batch", batch), ("--repeats", args.repeats)):
        check_integer(name, value, 1)
    materials = [Material(law, YOUNG, poisson) for law in args.laws for poisson in args.poisson]
    anatomy = read_anatomy(args.anatomy or get_template_path())
    trial = SolverTrial(anatomy, (), args.element, devices[0], batch)
    sets = sample_loads(anatomy, args.presets or (BALL_PRESETS if args.poses else PRESETS), count, args.poses)
    groups: list[tuple[dict[str, Drawn], tuple[Effect, ...]]] = [(sets, ())]
    if args.poses:
        groups = [({name: loads}, (ToolContact((choose_ball(name),)),)) for name, loads in sets.items()]
    table = sys.stderr if args.json else sys.stdout
    where = describe_machine(devices[0]) + (f"; at once on {', '.join(devices)}" if len(devices) > 1 else "")
    print(where, file=table)
    found: list[ThroughputRow] = []
    with tqdm(total=len(materials) * len(sets) * (args.repeats + 2), unit="solve", file=sys.stderr) as bar:
        measured = (
            measure_rates(trial, material, some, args.repeats, bar.update, tools, devices)
            for material in materials
            for some, tools in groups
        )
        for row in chain.from_iterable(measured):
            with tqdm.external_write_mode(table):
                if not found:
                    print(_header(row, batch, args.repeats), file=table)
                print(_line(row), file=table, flush=True)
            found.append(row)
    tools = combine_rows(found)
    print("", *map(_sentence, tools), sep="\n", file=table)
    if args.json:
        said = {"machine": where, "batch": batch, "rows": [{**asdict(row), "rate": row.rate} for row in found]}
        print(json.dumps({**said, "tools": [{**asdict(item), "rate": item.rate} for item in tools]}))
    return 0 if all(row.converged == row.loads for row in found) else 1


def _header(row: ThroughputRow, batch: int, repeats: int) -> str:
    each = "" if row.devices == 1 else f"; {row.devices} processes, each with all loads of a set"
    done = f"preconditioner: {row.preconditioner}; batches of at most {batch}, E {YOUNG:g} Pa, to {TRAIN.tolerance:g}"
    head = f"\n\n| {' | '.join(NAMES)} |\n|{'---|' * len(NAMES)}"
    return f"{done} in {TRAIN.precision}, median of {repeats}{each}{head}"


def _line(row: ThroughputRow) -> str:
    cells = (
        row.law, f"{row.poisson:g}", row.element, row.nodes, row.preset, row.loads, row.converged,
        f"{row.steps_median:g}", f"{row.steps_p99:g}", format_number(row.rate), format_number(1e6 / row.rate),
        format_number(row.loads / row.draw_seconds), f"<= {row.double:.1e} of {row.checked}",
    )  # fmt: skip
    return f"| {' | '.join(map(str, cells))} |"


def _sentence(item: ToolsRow) -> str:
    tissue = f"{item.law}, nu {item.poisson:g}: set-up {item.set_up:.3g} s"
    if item.rate is None:
        return tissue
    names, rate = ", ".join(item.presets), format_number(item.rate)
    drawing = format_number(item.loads / (item.seconds + item.draw_seconds))
    return (
        f"{tissue}; the tools together ({names}): {item.loads} loads in {item.seconds:.3g} s, "
        f"{rate} solves/s; {drawing} with drawing them"
    )
