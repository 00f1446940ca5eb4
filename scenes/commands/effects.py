"""`sulcus effects`: measure the computing time and the influence of each effect of a scene."""

import argparse
import sys
from dataclasses import asdict
from pathlib import Path

from sim.arguments import check_integer
from sim.errors import InputError
from sim.runtime.threads import choose_threads

from ..options.outputs import check_output_path
from ..options.patient_options import add_trajectory, build_requested_scene
from ..options.shared_options import add_anatomy, add_device, add_json, to_json_line
from ..options.tissue_options import add_model_tissue

# Column titles of the table.
COLUMN_TITLES = "effect", "ms a frame", "MB on the device", "tumour mm", "cortex mm", ""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument("scenes", nargs="*", help="built-in scenes, or MY_SCENE.py (default: all built-in scenes)")
    parser.add_argument("--every", type=int, default=5, help="solve every Nth frame")
    parser.add_argument(
        "--out", type=Path, metavar="FILE.json",
        help="file to which scenes are added; `sulcus demo` shows MESH.effects.json next to the anatomy. Only effects "
        "that the page can disable are solved",
    )  # fmt: skip
    add_anatomy(parser)
    add_trajectory(parser)
    add_model_tissue(parser)
    add_device(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Solve each scene with and without each effect, and report the differences; return 1 if a scene is not solved."""
    from tqdm import tqdm

    from ..play.deformers import open_theatre
    from ..play.effect_ablation import build_record, list_switchable_effects, measure_effects
    from ..play.effect_record import format_unphysical, read_effect_records, write_effect_record
    from ..script.scene import SCENES

    check_integer("--every", args.every, 1)
    names = args.scenes or SCENES
    patient = open_theatre(args.anatomy, device=args.device, scenes=names)
    scenes = [build_requested_scene(args, name, patient) for name in names]
    if args.out is not None:
        check_output_path(args.out, ".json", resumed=True)
        read_effect_records(args.out)
    table, reports = sys.stderr if args.json else sys.stdout, []
    for scene in scenes:
        found = []
        try:
            who, acting = patient.describe_deformer("fem", scene), scene.get_effects_on(patient.anatomy)
            some = None if args.out is None else list_switchable_effects(scene, patient.anatomy)
            print(f"{scene.name} by {who}: all effects together, then what each adds to the others\n", file=table)
            print(f"| {' | '.join(COLUMN_TITLES)} |\n|{'---|' * len(COLUMN_TITLES)}", file=table)
            total = 1 + len(acting if some is None else some)
            with tqdm(total=total, unit="effect", leave=False, file=sys.stderr) as bar:
                for row in measure_effects(patient, scene, args.every, some):
                    found.append(row)
                    figures = (row.milliseconds, row.held_mb, row.tumour_mm, row.cortex_mm)
                    cells = ["" if figure is None else f"{figure:.2f}" for figure in figures]
                    remark = row.refused or format_unphysical(row.unphysical)
                    bar.write(f"| {' | '.join([row.effect, *cells, remark])} |", file=table)
                    bar.update()
        except InputError as error:
            print(f"{args.program}: {scene.name}: {error}", file=sys.stderr)
            reports.append({"scene": scene.name, "error": str(error)})
            continue
        reports.append({"scene": scene.name, "solver": who, "effects": [asdict(row) for row in found]})
        if args.out is not None:
            hardware = _describe_hardware(args.device, len(patient.anatomy.mesh.tets))
            write_effect_record(args.out, build_record(patient, scene, found, args.every, hardware))
    if args.json:
        print(to_json_line(reports[0] if len(args.scenes) == 1 else {"scenes": reports}))
    return int(any("error" in report for report in reports))


def _describe_hardware(device: str, elements: int) -> str:
    """Describe the device, the processor, and the number of threads of the solver's loops."""
    from ..analysis.measurement import describe_machine

    names = describe_machine(device).partition(";")[0].rpartition(",")[0]  # without versions and all cores
    return f"{names}, solver threads: {choose_threads(elements)}"
