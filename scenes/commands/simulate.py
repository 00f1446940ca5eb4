"""`sulcus simulate`: sample loads of a tool, solve them by FEM, and store the displacements in a data set."""

import argparse
import json
import sys
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import h5py
import numpy as np
from tqdm import tqdm

from sim.accuracy import Accuracy
from sim.anatomy import Anatomy
from sim.bodies.meshfile import read_anatomy
from sim.deformation import Outcome
from sim.effects import Effect, NodalForce, ToolContact, ToolForce, build_push_effects
from sim.errors import InputError
from sim.loads import Loads
from sim.material import Tissue
from sim.runtime.device import parse_device_names
from sim.runtime.memory import MemoryBudget
from sim.runtime.partial_files import to_unfinished_path
from sim.runtime.timing import time_stage
from sim.runtime.versions import get_version
from sim.tools import Ball, BuiltIn, Capsule, Spatula
from surrogate.data.dataset import read_outcomes
from surrogate.data.load_histories import HISTORY, sample_times
from surrogate.data.simulate import SimulatedRows, simulate
from surrogate.data.solution_rows import describe_tissue_source
from surrogate.data.solver_pool import LazyFem, open_solvers
from surrogate.data.tool_loads import OVERLOAD_PRESETS, PRESETS, compute_rejected_share, describe_rejected_loads, draw
from surrogate.data.tool_poses import choose_ball, draw_poses

from ..options.outputs import add_force, check_output_path, read_attributes, read_batch_size, remove_outdated_data
from ..options.shared_options import add_devices, add_json, add_seed
from ..options.tissue_options import (
    add_element_argument,
    add_skull_argument,
    add_tissue_arguments,
    parse_elasticity,
    parse_tissue,
)
from ..script.shipped_files import get_template_path
from .interrupt import INTERRUPTED_CODE, interrupt_on_termination

MIN_TOOL_MM = 0.1  # Smallest size of a tool that presses on a brain [mm].
MAX_TOOL_MM = 200.0  # Largest size of a tool that presses on a brain [mm].


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument(
        "anatomy",
        nargs="?",
        metavar="ANATOMY.vtu",
        help="anatomy from `sulcus anatomy` (default: the template that ships)",
    )
    parser.add_argument("--out", required=True, metavar="DATA.h5", help="output data set; resumed if incomplete")
    parser.add_argument("--count", type=int, default=2000, help="number of loads")
    parser.add_argument(
        "--tool-preset", choices=PRESETS, default="palpation",
        help="tool preset; mixed: all tools; seed: the published protocol; brutal: far beyond surgical loads"
    )  # fmt: skip
    parser.add_argument(
        "--pose-control",
        action="store_true",
        help="move a rigid tool by pose, instead of a force on its footprint (default shape: ball of the preset's mean "
        "radius)",
    )
    shape = parser.add_mutually_exclusive_group()
    shape.add_argument(
        "--scene", metavar="NAME", help="tool and poses of a scene under manual control, such as spatula"
    )
    shape.add_argument("--ball", type=float, metavar="MM", help="radius of a ball [mm], such as 7 in the scene palpate")
    shape.add_argument(
        "--capsule",
        type=float,
        nargs=2,
        metavar=("RADIUS", "LENGTH"),
        help="radius and length of the straight part of a round rod [mm], such as a dissector or a closed bipolar",
    )
    shape.add_argument(
        "--blade", type=float, nargs=3, metavar=("WIDTH", "LENGTH", "EDGE"),
        help="width, length and edge radius of a flat blade [mm], such as 12 26 1.5 in the scene retract",
    )  # fmt: skip
    add_seed(parser)
    add_tissue_arguments(parser)
    add_element_argument(parser)
    add_skull_argument(parser, ("bonded", "slide"))
    parser.add_argument("--tolerance", type=float, default=1e-4, help="tolerance of the relative residual")
    widest = f"up to {MemoryBudget.max_cases}, on CUDA {MemoryBudget.max_cases_on_cuda}"
    parser.add_argument(
        "--batch",
        type=int,
        help=f"number of loads solved together (default: as many as fit, {widest}; a resumed file keeps its own)",
    )
    add_devices(parser)
    add_force(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Simulate the loads; return 0 even if a load does not converge, because the data set records the outcomes."""
    out = check_output_path(args.out, ".h5", args.force, resumed="anatomy" in read_attributes(Path(args.out)))
    with time_stage("draw"):
        anatomy = read_anatomy(get_template_path() if args.anatomy is None else args.anatomy)
        if not len(anatomy.tumour_nodes):
            print(f"{args.anatomy}: has no tumour: `sulcus train` will reject the data.", file=sys.stderr)
        elasticity = parse_elasticity(args, anatomy.mesh)
        tissue = parse_tissue(args)
        tool, loads = _sample_loads(args, anatomy, tissue)
    precision = "float32" if args.tolerance >= 1e-4 else "float64"
    accuracy = Accuracy(args.tolerance, precision=precision, limit_strain=args.tool_preset not in OVERLOAD_PRESETS)
    effects: tuple[Effect, ...] = (*build_push_effects(anatomy, elasticity, args.skull), NodalForce())
    if tool is not None:
        passive = (effect for effect in effects if not isinstance(effect, ToolForce | NodalForce))
        effects = (*passive, ToolContact((tool,)))
    devices = parse_device_names(args.device)
    batch = read_batch_size(out) if args.batch is None else args.batch
    with ExitStack() as closing:
        stop_if_asked = closing.enter_context(interrupt_on_termination())
        with time_stage("set-up"):
            wanted = LazyFem(anatomy, effects, accuracy, args.element, batch, len(loads))
            solver = closing.enter_context(open_solvers(wanted, devices, partial(print, file=sys.stderr)))
        provenance = {
            "effects": repr(effects),
            **describe_tissue_source(elasticity),
            "element": solver.element,
            "accuracy": repr(accuracy),
            "device": devices[0].split(":")[0],
            "preset": args.tool_preset,
            "seed": str(args.seed),
            **({} if tool is None else {"shape": repr(tool)}),
            **({"history": HISTORY} if tool is not None and tissue.prony else {}),
            **{f"{name} version": get_version(name) for name in ("sulcus", "warp-lang", "numpy")},
        }
        if args.force:
            remove_outdated_data(out, {**provenance, "anatomy": anatomy.digest})
        bar = closing.enter_context(tqdm(unit="load", disable=args.json, file=sys.stderr))

        def progress(done: int, total: int) -> None:
            stop_if_asked()
            show_progress(bar, done, total)

        try:
            solved = simulate(out, solver.deformer, loads, provenance, solver.batch_size, progress)
        except KeyboardInterrupt:
            bar.close()  # ends the line of the progress bar
            print(f"stopped; run the same command again to resume from {to_unfinished_path(out)}", file=sys.stderr)
            return INTERRUPTED_CODE
    _print_report(args, solver.description, len(loads), solved)
    return 0


def show_progress(progress_bar: tqdm, completed: int, total: int) -> None:
    """Update a progress bar: `completed` of `total` rows are finished."""
    progress_bar.total = total
    progress_bar.update(completed - progress_bar.n)


def _sample_loads(args: argparse.Namespace, anatomy: Anatomy, tissue: Tissue) -> tuple[BuiltIn | None, Loads]:
    """Return the tool moved by poses (None for forces), and sampled loads, with times if the tissue relaxes."""
    asked = _build_requested_tool(args)
    if not args.pose_control:
        if asked is not None or args.scene is not None:
            raise InputError(
                "--scene, --ball, --capsule and --blade are moved by pose: give --pose-control too, or leave them out."
            )
        return None, draw(args.tool_preset, anatomy, args.count, args.seed)
    if args.scene is None:
        tool = choose_ball(args.tool_preset) if asked is None else asked
        loads = draw_poses(args.tool_preset, anatomy, args.count, args.seed, tool)
    else:  # imports that are not needed for training alone
        from ..script.craniotomy_frame import build_craniotomy_frame
        from ..script.scene import find_scene
        from ..script.scene_poses import sample_scene_poses

        tool, loads = sample_scene_poses(find_scene(args.scene), build_craniotomy_frame(anatomy), args.count, args.seed)
    return tool, Loads(loads.causes, sample_times(len(loads), args.seed)) if tissue.prony else loads


def _build_requested_tool(args: argparse.Namespace) -> BuiltIn | None:
    """Build the tool of --ball, --capsule or --blade; None without such an option.

    Raises
    ------
    InputError
        A size [mm] of the tool is out of range.
    """
    for name, sizes in (("ball", [args.ball]), ("capsule", args.capsule), ("blade", args.blade)):
        if sizes and sizes[0] is not None and not all(MIN_TOOL_MM <= size <= MAX_TOOL_MM for size in sizes):
            raise InputError(
                f"--{name} {' '.join(f'{size:g}' for size in sizes)}: sizes are in millimetres: give "
                f"{MIN_TOOL_MM:g} to {MAX_TOOL_MM:g} each."
            )
    if args.ball is not None:
        return Ball(args.ball / 1e3)
    if args.capsule is not None:
        return Capsule(*(size / 1e3 for size in args.capsule))
    return None if args.blade is None else Spatula(*(size / 1e3 for size in args.blade))


def _print_report(args: argparse.Namespace, solver: str, count: int, solved: SimulatedRows) -> None:
    with h5py.File(args.out, "r") as file:
        outcomes, units = read_outcomes(file, "answers"), len(read_outcomes(file, "unit"))
    counts = {outcome.name.lower(): outcomes.count(outcome) for outcome in Outcome if outcome in outcomes}
    failed = int(np.sum([not outcome.good for outcome in outcomes]))
    rate = solved.load_count / solved.load_seconds if solved.load_count else None
    if args.json:
        report = {
            "out": args.out,
            "solver": solver,
            "loads": len(outcomes),
            "unit": units,
            "solved_now": solved.total,
            "outcome": counts,
            "seconds": {"unit responses": solved.unit_seconds, "loads": solved.load_seconds},
            "loads_per_second": rate,
            "nominal_refused": 0.0 if args.pose_control else compute_rejected_share(args.tool_preset),
        }
        print(json.dumps(report))
        return
    if count < args.count:
        print(f"the preset {args.tool_preset} has {count} loads: all of them were taken.")
    if len(outcomes) > count:
        print(
            f"{args.out} already holds {len(outcomes)} loads, more than the {count} asked for: nothing was taken away."
        )
    listed = ", ".join(f"{number} {name}" for name, number in counts.items())
    print(
        f"{args.out}: {len(outcomes)} loads ({listed}) and {units} unit responses; {solved.total} solved in this run."
    )
    print(f"Solved by {solver}.")
    if rate is not None:
        print(f"{rate:.3g} loads per second, with sampling and writing.")
    if not args.pose_control and describe_rejected_loads(args.tool_preset):
        print(describe_rejected_loads(args.tool_preset))
    if failed:
        print(f"{failed} solutions are unreliable (see their outcomes): they stay in the file, but no model uses them.")
