"""`python -m benchmarks fit`: errors of `sulcus fit` on synthetic patients of known tissue."""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from scenes.options.shared_options import add_anatomy, add_device, add_json, add_seed
from sim.arguments import check_integer

from .locate import check_finer_mesh, open_locator, read_finer_mesh, show_progress

HEADS = (
    "noise", "ratio: off by", "within x1.5 [%]", "in its interval [%]", "held or sliding [%]", "skull [%]",
    "Poisson's class [%]", "E: off by", "within 20 % [%]", "in its interval [%]", "patients, with force",
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_anatomy(parser)
    parser.add_argument("--finer", type=Path, metavar="FINER.vtu", help="finer mesh of the same brain, for the truth")
    parser.add_argument("--nodes", type=int, default=8000, help="nodes of the template's finer mesh")
    parser.add_argument("--twins", type=int, default=20, help="number of patients")
    parser.add_argument("--presses", type=int, default=2, help="number of frames with a tool")
    parser.add_argument("--drained", type=int, default=4, help="number of frames with drained fluid")
    parser.add_argument("--forces", type=int, default=4, help="number of patients with a measured force")
    parser.add_argument("--points", type=int, default=100, help="observed points in a frame")
    parser.add_argument("--cover", type=int, default=80, help="observed share of the open cortex [%%]")
    parser.add_argument(
        "--noise", nargs="+", type=int, default=[0, 1, 2], choices=(0, 1, 2), help="levels, as in `benchmarks locate`"
    )
    add_seed(parser, "the patients")
    add_device(parser)
    parser.add_argument("--locator", type=Path, metavar="FILE.npz", help="locator of the anatomy (default: a new one)")
    parser.add_argument("--folder", type=Path, help="folder of results, from which a stopped run resumes")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Measure; return 1 if some patient has no equilibrium."""
    from scenes.script.shipped_files import get_template_path
    from sim.bodies.meshfile import read_anatomy

    from ..studies.fit_study import fit_patient, solve_library, summarise_fits
    from ..studies.fit_twins import solve_patients
    from ..studies.locate_study import PointModel

    for name, least in (("twins", 1), ("presses", 1), ("drained", 0), ("forces", 0), ("points", 6), ("cover", 1)):
        check_integer(f"--{name}", getattr(args, name), least)
    check_finer_mesh(args)
    body, finer = read_anatomy(args.anatomy or get_template_path()), read_finer_mesh(args)
    with show_progress("patients") as heard:
        every = list(
            solve_patients(
                body, finer, args.twins, args.presses, args.drained, args.seed, args.device, args.folder, heard
            )
        )
    found = [seen for seen in every if seen is not None]
    locator = open_locator(args, body)
    with show_progress("tissues") as heard:
        library = solve_library(locator, args.device, args.folder and args.folder / "fit.parts", heard)
    table = sys.stderr if args.json else sys.stdout
    print(f"| {' | '.join(HEADS)} |\n|{'---|' * len(HEADS)}", file=table)
    made = []
    for noise in args.noise:
        sight, said = PointModel(args.points, args.cover, noise), []
        with show_progress("fits") as heard:
            for number, seen in enumerate(found):
                tissue = fit_patient(locator, library, seen, sight, args.seed, number < args.forces, args.device)
                said.append((seen.patient, tissue))
                heard(number + 1, len(found))
        made.append(summarise_fits(noise, said))
        print(f"| {' | '.join(_cells(asdict(made[-1])))} |", file=table, flush=True)
    failed = len(every) - len(found)
    if args.json:
        print(json.dumps({"failed": failed, "rows": [asdict(each) for each in made]}))
    if failed:
        print(f"benchmarks fit: no equilibrium was found of {failed} patients: they are in no row", file=sys.stderr)
    return 1 if failed else 0


def _cells(row: dict[str, float | None]) -> list[str]:
    """Format the cells of a table row."""

    def said(name: str, digits: int = 0) -> str:
        value = row[name]
        return "" if value is None else f"{value:.{digits}f}"

    shares = [said(name) for name in ("within", "held", "sliding", "skull", "poisson")]
    young = [said("young", 2), said("young_within"), said("young_held")]
    return [said("noise"), said("factor", 2), *shares, *young, f"{said('patients')}, {said('forces')}"]
