"""`python -m benchmarks locate`: share of a tumour's motion that `sulcus locate` and baselines estimate."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from scenes.options.shared_options import add_anatomy, add_device, add_json, add_seed
from sim.arguments import check_integer
from sim.elements import ELEMENTS, RECOMMENDED
from sim.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from sim.anatomy import Anatomy
    from surrogate.locating.locator import Locator

    from ..studies.locate_study import LocateRow

HEADS = (
    "points", "cover [%]", "noise", "estimator", "removed [%]", "error: mean [mm]", "p95 [mm]", "in the 95 % ellipsoid",
    "refused", "in doubt", "warned", "ms",
)  # fmt: skip

# Largest simulated slip of a registration [mm].
MOST_SLIPPED = 50.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_anatomy(parser)
    parser.add_argument(
        "--finer", type=Path, metavar="FINER.vtu",
        help="finer mesh of the same brain, for the ground truth (default: the template's, of --nodes)",
    )  # fmt: skip
    parser.add_argument("--nodes", type=int, default=8000, help="nodes of the template's finer mesh, without --finer")
    parser.add_argument(
        "--element", choices=ELEMENTS, default=RECOMMENDED,
        help="finite element of the ground truth (default: %(default)s); p2 takes minutes per case on a CPU",
    )  # fmt: skip
    parser.add_argument("--twins", type=int, default=20, help="number of test cases, a quarter by each cause")
    parser.add_argument("--points", nargs="+", type=int, default=[100], help="observed points (default: 100)")
    parser.add_argument(
        "--cover", nargs="+", type=int, default=[36], help="observed share of the open cortex [%%] (default: 36)"
    )
    parser.add_argument(
        "--noise", nargs="+", type=int, default=[0, 1, 2], choices=(0, 1, 2),
        help="levels (default: 0 1 2). 0: none. 1, 2: independent 0.3, correlated 0.5 mm, and a rigid error of half a "
        "degree and 1 or 2 mm, whose size `sulcus locate` is given",
    )  # fmt: skip
    parser.add_argument(
        "--clouds", action="store_true", help="observe point clouds, without correspondences; baselines are left out"
    )
    parser.add_argument(
        "--slip", type=float, default=0.0, metavar="MM",
        help="registration slip: displacement of all points along the open cortex [mm] (default: 0)",
    )  # fmt: skip
    parser.add_argument(
        "--wrong-registration", action="store_true",
        help="wrong registration: displace all points by 2 to 5 mm or rotate by 2 to 4 degrees, at random",
    )  # fmt: skip
    parser.add_argument(
        "--locator", type=Path, metavar="FILE.npz", help="locator of the anatomy (default: a new one, kept in --folder)"
    )
    add_seed(parser, "the twins and of what is seen")
    add_device(parser)
    parser.add_argument(
        "--folder", type=Path, help="folder of meshes, cases and locator, to resume a stopped run (default: none)"
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Measure, row by row; return 1 if some synthetic case has no equilibrium."""
    from scenes.analysis.measurement import describe_machine
    from scenes.script.shipped_files import get_template_path
    from sim.bodies.meshfile import read_anatomy

    from ..studies.locate_rivals import build_baselines
    from ..studies.locate_study import build_point_models, measure_baselines
    from ..studies.locate_twins import solve_cases

    _check(args)
    body = read_anatomy(args.anatomy or get_template_path())
    finer = read_finer_mesh(args)
    with show_progress("twins") as heard:
        found = list(solve_cases(body, finer, args.twins, args.seed, args.device, args.element, args.folder, heard))
    failed = [number for number, twin in enumerate(found) if twin is None]
    some = [twin for twin in found if twin is not None]
    locator = open_locator(args, body)
    table = sys.stderr if args.json else sys.stdout
    where = f"{describe_machine(args.device)}; truths of {len(finer.mesh.nodes)} nodes, {args.element}"
    print(f"{where}\n\n{len(some)} twins\n\n| {' | '.join(HEADS)} |\n|{'---|' * len(HEADS)}", file=table)
    others = {
        "has_correspondences": not args.clouds,
        "slip": 1e-3 * args.slip,
        "is_misregistered": args.wrong_registration,
    }
    sights = build_point_models(args.points, args.cover, args.noise, **others)
    made = []
    with show_progress("observations") as heard:
        for row in measure_baselines(some, sights, build_baselines(body), locator, args.seed, heard):
            made.append(row)
            print(f"| {' | '.join(_cells(row))} |", file=table, flush=True)
    if failed:
        print(f"benchmarks locate: no equilibrium was found of twins {failed}: they are in no row", file=sys.stderr)
    if args.json:
        print(json.dumps({"machine": where, "failed": failed, "rows": [asdict(row) for row in made]}))
    return 1 if failed else 0


def _check(args: argparse.Namespace) -> None:
    """Check the arguments before anything is solved.

    Raises
    ------
    InputError
        Counts, shares or a seed out of range; a user's brain without its finer mesh.
    """
    check_integer("--twins", args.twins, 1)
    check_integer("--seed", args.seed, 0)
    for count in args.points:
        check_integer("--points", count, 6)
    for cover in args.cover:
        if not 1 <= cover <= 100:
            raise InputError(f"--cover {cover}: give a share of the open cortex, from 1 to 100 [%].")
    if not 0.0 <= args.slip <= MOST_SLIPPED:
        raise InputError(
            f"--slip {args.slip:g}: give how far all points are displaced, from 0 to {MOST_SLIPPED:g} [mm]."
        )
    check_finer_mesh(args)


def check_finer_mesh(args: argparse.Namespace) -> None:
    """Raise InputError for a user's brain without its finer mesh."""
    if args.anatomy is not None and args.finer is None:
        raise InputError("--anatomy needs --finer: a finer mesh of the same brain, by `sulcus anatomy --nodes`.")


def read_finer_mesh(args: argparse.Namespace) -> Anatomy:
    """Return the mesh on which the ground truths are solved."""
    from sim.bodies.meshfile import read_anatomy, write_anatomy
    from sim.bodies.subject import MeshPlan, make_anatomy
    from sim.bodies.template import Tumour, build_template_subject

    kept = args.finer or (args.folder and args.folder / f"template-{args.nodes}.vtu")
    if args.finer or (kept and kept.is_file()):
        return read_anatomy(kept)
    print(f"benchmarks locate: meshing with about {args.nodes} nodes ...", file=sys.stderr)
    anatomy = make_anatomy(build_template_subject(Tumour()), MeshPlan(args.nodes))
    if kept:
        kept.parent.mkdir(parents=True, exist_ok=True)
        write_anatomy(kept, anatomy)
    return anatomy


def open_locator(args: argparse.Namespace, anatomy: Anatomy) -> Locator:
    """Read the given locator, or the one in the folder, or build a new one."""
    from surrogate.locating.locator_store import load_locator, make_locator, save_locator

    path = args.locator or (args.folder and args.folder / f"{anatomy.digest}.locator.npz")
    if args.locator or (path and path.is_file()):
        return load_locator(path, anatomy)
    parts = None if path is None else path.with_suffix(".parts")
    with show_progress("locator") as heard:
        locator = make_locator(
            anatomy, device=args.device, folder=parts, progress=lambda stage, done, total: heard(done, total, stage)
        )
    if path is not None:
        save_locator(path, locator)
    return locator


@contextmanager
def show_progress(name: str) -> Iterator[Callable[..., None]]:
    """Show a progress bar on the error stream; yield a function that sets its count, total and stage."""
    from tqdm import tqdm

    with tqdm(desc=name, file=sys.stderr) as bar:

        def heard(done: int, total: int, stage: str = name) -> None:
            bar.total, bar.n = total, done
            bar.set_description(stage)

        yield heard


def _cells(row: LocateRow) -> Iterable[str]:
    """Format the cells of a table row."""
    held = "" if row.held is None else f"{row.held:.0f} %"
    took = "" if row.milliseconds is None else f"{row.milliseconds:.3g}"
    return (
        f"{row.points}", f"{row.cover}", f"{row.noise}", row.estimator, f"{row.removed:.0f}", f"{row.mean:.2f}",
        f"{row.p95:.2f}", held, f"{row.refused or ''}", f"{row.doubted or ''}",
        f"{row.warned or ''}", took,
    )  # fmt: skip
