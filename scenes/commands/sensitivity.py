"""`sulcus sensitivity`: compare the influence of modelling choices on the tumour's motion with a surrogate's error."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from sim.elements import ELEMENTS
from sim.errors import InputError
from surrogate.data.tool_loads import PRESETS, draw

from ..options.outputs import add_force, check_output_path
from ..options.patient_options import add_model_options
from ..options.shared_options import add_device, add_json, add_seed, to_json_line

if TYPE_CHECKING:
    from surrogate.model.learned import Learned

    from ..analysis.sensitivity import MotionChange, SensitivityRow, SensitivityStudy

# Column titles of the table.
COLUMN_TITLES = ("factor", "default", "now", "F mean", "F 95", "F %", "F x", "M mean", "M 95", "M %", "M x")
COLUMN_WIDTHS = (18, 11, 9, 6, 6, 6, 5, 6, 6, 6, 5)
"""Widths of the table's columns [characters]; a line has at most 120 characters."""
# Explanation under the table.
NOTE = """
One factor is changed at a time. F: tools of prescribed force. M: the same tools with the motion of the default under
those forces. Columns: difference of the tumour's displacement from the default. Mean [mm]: over load x vertex; 95 [mm]:
95th percentile over loads of the maximum vertex difference, comparable with a surrogate's bound. %: mean difference
relative to the motion; x: motion relative to the default's. --out and --json also give the 95th percentile over load x
vertex and the maximum. Tool errors are computed for more and less, about two axes, to four sides along the cortex.
"""

# Influence of the element on the rows of nu, measured by `python -m benchmarks elements` on the default brain.
LOCKING_NOTES = {
    "p1": "Linear tetrahedra lock as nu approaches 0.5: much of its effect here is locking. Use --element smoothed.",
    "smoothed": "Smoothed elements, because linear ones lock as nu nears 0.5; at 0.495 these still lose about 5 %.",
    "p2": "Quadratic elements lock little: at nu 0.495 they still lose about 4 %.",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    add_model_options(parser)
    parser.add_argument(
        "--element", choices=ELEMENTS,
        help="element; linear tetrahedra lock near nu = 0.5 (default: smoothed; p2 for meshes with mid-edge nodes)",
    )  # fmt: skip
    parser.add_argument(
        "--compare", nargs="+", choices=ELEMENTS, default=[], metavar="ELEMENT",
        help="also compute with these elements on the same mesh, to show the discretisation error",
    )  # fmt: skip
    parser.add_argument("--tool-preset", choices=PRESETS, default="palpation", help="tool preset")
    parser.add_argument("--count", type=int, default=32, help="number of sampled loads")
    add_seed(parser)
    add_device(parser)
    parser.add_argument(
        "--factorial", action="store_true",
        help="compute every combination of skull, Poisson's ratio, opening, depth and stiffness of the template's "
        "tumour, instead of one change at a time (an hour on two cores); --out then also gets a plot (.png)",
    )  # fmt: skip
    parser.add_argument("--nodes", type=int, default=5300, help="number of mesh nodes with --factorial")
    parser.add_argument("--out", type=Path, metavar="TABLE.csv", help="output table, unrounded")
    add_force(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Solve all variants and print the table; return 1 if a solve did not converge, else 0."""
    from ..analysis.measurement import describe_machine, write_table
    from ..analysis.sensitivity import BodyVariant, SensitivityStudy, list_variants, measure_variants
    from ..play.deformers import open_theatre

    if args.out:
        check_output_path(args.out, ".csv", args.force)
    if args.factorial:
        return _run_factorial(args)
    patient = open_theatre(args.anatomy, args.model, args.device)
    anatomy = patient.anatomy
    pushed = (model for model in patient.models.values() if model.tool is None)
    model = min(pushed, key=lambda model: model.bound, default=None)
    loads = draw(args.tool_preset, anatomy, args.count, args.seed)
    body = BodyVariant(element=args.element or ("smoothed" if anatomy.mesh.middles is None else "p2"))
    study = SensitivityStudy(anatomy, loads, body, device=args.device)
    changed = list_variants(anatomy, body, args.compare)
    where = describe_machine(args.device)
    lines = sys.stderr if args.json else sys.stdout
    print(
        f"{where}\n\n{_describe_study(study, args.tool_preset)}\n\n{_format_row(COLUMN_TITLES)}\n"
        f"{_format_row(['-' * width for width in COLUMN_WIDTHS])}",
        file=lines,
        flush=True,
    )
    found = []
    with tqdm(total=1 + len(changed), unit="row", file=sys.stderr) as bar:
        for row in measure_variants(study, changed):
            found.append(row)
            names = (row.variant.factor, row.variant.default, row.variant.changed)
            bar.write(_format_row((*names, *_format_cells(row.force), *_format_cells(row.motion))), file=lines)
            bar.update()
    table = [_flatten_row(row) for row in found]
    if args.out:
        write_table(args.out, table)
    failed = sum(row.force.failed + row.motion.failed for row in found)
    if args.json:
        stated = {"preset": args.tool_preset, "loads": len(loads), "seed": args.seed, "default": asdict(body)}
        surrogate = _get_reported_error(model) if model else None
        whole = {"machine": where, **stated, "failed": failed, "surrogate": surrogate, "rows": table}
        print(to_json_line(whole))
    else:
        print("\n".join([*_format_surrogate_row(model), NOTE, *_list_remarks(study, args.compare, model, failed)]))
    return 1 if failed else 0


def _run_factorial(args: argparse.Namespace) -> int:
    """Solve all combinations of factors, and print shares of variance; return 1 if a solve did not converge, else 0."""
    from math import prod

    from ar.screen import write_png

    from ..analysis.factorial import LEVELS, build_panels, compute_variance_shares, solve_levels
    from ..analysis.loglog_chart import draw_panels
    from ..analysis.measurement import write_table

    if args.anatomy:
        raise InputError("--factorial makes its bodies of the template: leave --anatomy out.")
    picture = args.out and check_output_path(args.out.with_suffix(".png"), ".png", args.force)
    total = prod(map(len, LEVELS.values()))
    found = list(tqdm(solve_levels(nodes=args.nodes, device=args.device), total=total, unit="cell", file=sys.stderr))
    table = [{**cell.levels, "force_mm": cell.force, "motion_mm": cell.motion} for cell in found]
    failed = sum(not np.isfinite(value) for cell in found for value in (cell.force, cell.motion))
    parts = {response: compute_variance_shares(found, response) for response in ("force", "motion")}
    if args.out:
        write_table(args.out, table)
        write_png(picture, draw_panels(build_panels(found)))
    if args.json:
        print(to_json_line({"failed": failed, "shares": parts, "rows": table}))
        return 1 if failed else 0
    print("Of the variance of the motion's logarithm, known force and known motion of the tool:")
    for name, share in parts["force"].items():
        print(f"| {name:<36} | {share:6.1%} | {parts['motion'][name]:6.1%} |")
    for response in parts:
        values = [row[f"{response}_mm"] for row in table]
        print(f"Known {response}: the tumour moves by {np.nanmin(values):.2f} to {np.nanmax(values):.2f} mm.")
    if failed:
        print(f"{failed} solves did not converge: they are in no figure.")
    return 1 if failed else 0


def _describe_study(study: SensitivityStudy, preset: str) -> str:
    tissue, skull = study.body.tissue, study.body.skull if study.anatomy.slide_normal.any() else "none"
    return (
        f"{len(study.loads)} {preset} loads on {len(study.anatomy.mesh.nodes)} vertices. By default: element "
        f"{study.body.element}, {tissue.law}, E {tissue.young:g} Pa, nu {tissue.poisson:g}, the tumour "
        f"{study.body.tumour:g} x as stiff; skull: {skull}."
    )


def _format_surrogate_row(model: Learned | None) -> list[str]:
    """Format the table row of the surrogate's error bound, as a list of lines; empty without a bound."""
    if model is None or not np.isfinite(model.bound):
        return []
    bound = ("", f"{1e3 * model.bound:.3f}", "", "")
    return [_format_row(("surrogate's error", "", model.training.get("learner", "learnt"), *bound, *[""] * 4))]


def _format_cells(change: MotionChange) -> tuple[str, ...]:
    if not change.solves:
        return ("none", "solved", "", "")
    lengths = (change.mean_mm, change.worst95_mm)
    return *(f"{length:.3f}" for length in lengths), f"{change.percent:.1f}", f"{change.motion:.3f}"


def _format_row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(f'{cell:<{width}}' for cell, width in zip(cells, COLUMN_WIDTHS, strict=True))} |"


def _list_remarks(study: SensitivityStudy, elements: Sequence[str], model: Learned | None, failed: int) -> list[str]:
    """List remarks on the table as sentences: failed solves, meaning of the surrogate's error, missing rows."""
    remarks = []
    if failed:
        remarks.append(f"{failed} solves did not converge: they and their comparisons are excluded.")
    if model is not None and _format_surrogate_row(model):
        stated = _get_reported_error(model)
        remarks.append(
            f"Surrogate error: reported bound on held-out {stated['preset']} loads relative to its own "
            f"FEM with element {stated['element']}. Use --compare for the error of that element."
        )
    else:
        remarks.append("No surrogate error is given: there is no model with a bound next to this anatomy (--model).")
    remarks.append(LOCKING_NOTES[study.body.element])
    if not elements:
        remarks.append("No discretisation error is given: --compare p2 compares quadratic elements on this mesh.")
    if not study.anatomy.slide_normal.any():
        remarks.append("This anatomy has no skull: there is no row for the skull.")
    return remarks


def _get_reported_error(model: Learned) -> dict[str, Any]:
    """Return the reported error bound [mm] of a model, with its name, load preset and element type."""
    training = model.training
    about = {name: training.get(name, "unknown") for name in ("learner", "preset")}
    return {**about, "element": training.get("element", "p1"), "bound_mm": 1e3 * model.bound}


def _flatten_row(row: SensitivityRow) -> dict[str, Any]:
    variant = row.variant
    sides = {"force": row.force, "motion": row.motion}
    figures = {f"{side} {name}": value for side, change in sides.items() for name, value in asdict(change).items()}
    return {"what": variant.factor, "default": variant.default, "now": variant.changed, **figures}
