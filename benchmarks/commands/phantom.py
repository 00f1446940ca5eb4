"""`python -m benchmarks phantom`: motion of the lesion of a silicone brain phantom, measured and predicted."""

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from scenes.options.outputs import add_force, check_output_path
from scenes.options.shared_options import add_device
from sim.errors import InputError
from sim.runtime.atomic_files import write_atomically

COLUMNS = ("motion", "source", "shift [mm]", "centroid error [mm]", "surface distance [mm]", "marker error [mm]")
LEGEND = """
motion: from one scan to another. a: in air; b: fluid up to 0 mm; c: fluid up to 75 mm.
source: measured by CT; no motion; FEM of the change of the fluid level; FEM fitted to the four surface markers.
shift: length of the displacement of the lesion's centroid.
centroid error: length of its difference from the measured displacement.
surface distance: mean distance of the moved lesion's vertices from the measured lesion.
marker error: RMS error of the displacements of the four surface markers."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "folder", type=Path, metavar="FOLDER", help="checkout of github.com/tanadul-s/brain-shift-prediction-v3"
    )
    add_device(parser)
    parser.add_argument("--out", type=Path, metavar="OUT.json", help="also write residuals and rows to this file")
    add_force(parser)


def run(args: argparse.Namespace) -> int:
    """Measure and predict; without the mesh of the body only measure, then report the missing file."""
    from ..studies.phantom_study import BODY, REMEDY, STATES, compare_motions, list_files, read_body, read_scan

    out = args.out and check_output_path(args.out, ".json", args.force)
    names = ("initial", *STATES)
    files = [path for name in names for path in list_files(name)]
    lacking = [str(path) for path in (*files, BODY) if not (args.folder / path).is_file()]
    ask = f"{BODY} is not public: ask the authors for it (T. Somboonwong, Mahidol University; address in their README)."
    if lacking and lacking != [str(BODY)]:
        raise InputError(f"{args.folder}: {lacking[0]} is missing ({len(lacking)} files in all). {REMEDY} {ask}")
    scans = {name: read_scan(args.folder, name) for name in names}
    body = None if lacking else read_body(args.folder, scans["initial"])
    residuals = {name: 1e3 * scan.residual for name, scan in scans.items()}
    print("RMS distance of the four reference markers from their design [mm]:", end=" ")
    print(", ".join(f"{name} {residual:.2f}" for name, residual in residuals.items()))
    print(f"\n| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    rows = []
    for row in compare_motions(scans, body, args.device):
        rows.append(row)
        values = (row.shift, row.centroid, row.surface, row.markers)
        cells = ("" if value is None else f"{value:.2f}" for value in values)
        print(f"| {' | '.join((row.motion, row.source, *cells))} |", flush=True)
    print(LEGEND)
    if out:
        with write_atomically(out, ".json") as partial:
            partial.write_text(json.dumps({"residuals": residuals, "rows": [asdict(row) for row in rows]}))
    if body is None:
        raise InputError(f"{args.folder}: no prediction, as the mesh of the body is missing. {ask}")
    return 0
