"""`sulcus uncertainty`: estimate the tumour position error of a scene, and the contribution of each source."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from sim.arguments import check_integer

from ..options.outputs import check_output_path
from ..options.patient_options import add_model_options, build_requested_scene
from ..options.shared_options import add_device, add_json, add_seed, to_json_line
from ..options.tissue_options import add_model_tissue
from .fit import find_fitted_tissue

if TYPE_CHECKING:
    from ..play.deformers import PatientSetup
    from ..script.priors import PatientSample
    from ..script.scene import Scene
    from ..script.uncertainty import Uncertainty

MIN_BODIES = 8  # Minimum number of bodies to solve.
# Explanation under the table.
NOTE = """
Two separate errors. "model": difference from FEM on the same mesh. "tumour": maximum distance between the predicted
surface and the tumour in the patient. It includes unknowns that are not measured: stiffness of tissue, skull, position
of the tool, registration, segmentation. Tissue law, force, fluid level and resection are taken as in the scene.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument("scenes", nargs="*", help="built-in scenes, or MY_SCENE.py (default: all built-in scenes)")
    add_model_options(parser)
    add_model_tissue(parser)
    parser.add_argument("--draws", type=int, default=40, help=f"number of sampled bodies to solve, >= {MIN_BODIES}")
    parser.add_argument(
        "--twins",
        type=int,
        default=20,
        help="synthetic patients, not among the draws, on which the bound is tested; 0: none",
    )
    parser.add_argument(
        "--tissue", type=Path, metavar="FILE.json",
        help="tissue fitted by `sulcus fit`, sampled instead of the priors (default: "
        "MESH.tissue.json next to the anatomy, if it exists)",
    )  # fmt: skip
    add_seed(parser, "the draws")
    add_device(parser, "finite elements")
    parser.add_argument(
        "--out", type=Path, metavar="FILE.json",
        help="file to which scenes are added (default: MESH.uncertainty.json next to the anatomy, for `sulcus demo`)",
    )  # fmt: skip
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Solve an ensemble of each scene, store the results next to the anatomy or in --out, and print them; return 0."""
    from ..analysis.uncertainty import (
        estimate_uncertainty,
        get_tissue,
        get_tumour_tissue,
        list_skulls,
        measure_coverage,
        solve_ensemble,
        solve_nominal,
    )
    from ..play.deformers import open_theatre
    from ..script.priors import sample_from_fit, sample_priors
    from ..script.scene import SCENES
    from ..script.shipped_files import get_template_path
    from ..script.uncertainty import read_uncertainties, to_uncertainty_path, write_uncertainties

    check_integer("--draws", args.draws, MIN_BODIES)
    check_integer("--twins", args.twins, 2 if args.twins else 0)
    names = args.scenes or SCENES
    patient = open_theatre(args.anatomy, args.model, args.device, names)
    scenes = [build_requested_scene(args, name, patient) for name in names]
    out = args.out or to_uncertainty_path(args.anatomy or get_template_path())
    # Check before hours of work: the tissue must have priors. An existing file is read, and scenes are added to it.
    for scene in scenes:
        get_tissue(scene)
    check_output_path(out, ".json", resumed=True)
    read_uncertainties(out)
    fitted = find_fitted_tissue(args.tissue, args.anatomy or get_template_path(), patient.anatomy.digest)

    def draw_samples(scene: Scene, count: int, seed: int) -> list[PatientSample]:
        tissue = get_tissue(scene)
        if fitted is None:
            return sample_priors(count, seed, tissue)
        ratio = get_tumour_tissue(scene).young / tissue.young
        return sample_from_fit(fitted, tissue, list_skulls(scene), count, seed, ratio)

    rows, lines = [], sys.stderr if args.json else sys.stdout
    for scene in scenes:
        bar = partial(tqdm, unit="body", desc=scene.name, leave=False, file=sys.stderr)
        draws, twins = (draw_samples(scene, *each) for each in ((args.draws, args.seed), (args.twins, args.seed + 1)))
        still = solve_nominal(patient, scene)
        found = estimate_uncertainty(
            patient, scene, still, draws, bar(solve_ensemble(patient, scene, draws), total=len(draws)), args.seed
        )
        found = replace(found, frames=0 if fitted is None else fitted.frames)
        if twins:
            write_uncertainties(out, [found])
            tried = bar(solve_ensemble(patient, scene, twins), total=len(twins))
            found = measure_coverage(scene, still, found, twins, tried, args.seed + 1)
        write_uncertainties(out, [found])
        rows.append(_summarise_scene(patient, scene, found))
        print("\n".join(_format_lines(rows[-1])), file=lines, flush=True)
    if args.json:
        print(to_json_line({"seed": args.seed, "out": str(out), "scenes": rows}))
    else:
        print(f"{NOTE}\nWritten to {out}.")
    return 0


def _summarise_scene(patient: PatientSetup, scene: Scene, result: Uncertainty) -> dict[str, Any]:
    """Summarise the results of a scene for JSON, at the time of the largest bound on the tumour's error."""
    from ..play.frame_text import format_errors

    model = patient.models.get(patient.select_best(scene))
    promised = None if model is None or not np.isfinite(model.bound) else float(model.bound)
    moment = int(np.argmax(result.worst))
    error = result.evaluate(result.times[moment], promised or 0.0)
    parts = {name: 1e3 * values[moment] for name, values in result.parts.items()}
    ranked = dict(sorted(parts.items(), key=lambda part: -part[1]))
    return {
        "scene": scene.name, "said": format_errors(promised, error, model is not None), "time_s": result.times[moment],
        "model_mm": None if promised is None else 1e3 * promised, "tumour_mm": 1e3 * (error.bound or 0.0),
        "middle_mm": 1e3 * result.middle[moment], "moved_mm": 1e3 * result.moved[moment],
        "largest_part": None if result.has_few_draws else error.main_source,
        "draws": result.draws, "failed": result.failed, "frames": result.frames, "folded": result.folded,
        "fitted_numbers": result.numbers, "few": result.has_few_draws, "guess": result.is_rough,
        "patients": result.patients, "covered": result.covered, "covered_deviation": result.deviation,
        "parts_mm": ranked,
    }  # fmt: skip


def _format_lines(row: dict[str, Any]) -> Sequence[str]:
    """Format the summary of a scene as lines of text."""
    lines = [f"{row['scene']}:", *(f"  {line}" for line in row["said"])]
    lines.append(
        f"  at {row['time_s']:.1f} s, when it moved {row['moved_mm']:.2f} mm; its middle is within "
        f"{row['middle_mm']:.1f} mm. Root mean square of each part [mm]:"
    )
    lines += [f"    {name:<20} {size:6.3f}" for name, size in row["parts_mm"].items()]
    if row["few"]:
        lines.append(
            f"  these parts are guesses: {row['fitted_numbers']} numbers are fitted to {row['draws'] - row['failed']} "
            f"draws. Give --draws {2 * row['fitted_numbers']} or more"
        )
    if row["frames"]:
        lines.append(f"  bodies are of tissue that was fitted to {row['frames']} frames, and not of priors alone")
    without = f", {row['failed']} of them without equilibrium" if row["failed"] else ""
    tested = "It was not tested on other patients"
    if row["patients"]:
        tested = f"It covered {row['covered']:.1%} +- {row['covered_deviation']:.1%} of errors on "
        tested += f"{row['patients']} synthetic patients that are not among them (95 % wanted)"
    lines.append(f"  the bound is of {row['draws']} draws{without}. {tested}")
    if row["folded"]:
        lines.append(
            f"  in {row['folded']} draws tetrahedra lie inside out, as under a tool on soft tumour: the load is beyond "
            "the law there, and the bound is a guess"
        )
    return lines
