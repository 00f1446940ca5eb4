"""`sulcus locator`: precompute the ensemble of an anatomy, which is reused for all observations."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from sim.arguments import check_integer
from sim.errors import InputError
from sim.material import BRAIN

from ..options.outputs import add_force, check_output_path
from ..options.shared_options import add_device, add_json, add_seed
from ..options.tissue_options import AS_LEARNED, add_region_argument, parse_region_tissues

if TYPE_CHECKING:
    from sim.anatomy import Anatomy
    from surrogate.locating.locator import Locator
    from surrogate.locating.regions import Region

# Help on the default stiffness of regions.
REGIONS = f"{AS_LEARNED}. A locator knows how many times a region is as stiff as a brain of {1e-3 * BRAIN.young:g} kPa"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument(
        "anatomy", metavar="ANATOMY.vtu", type=Path, help="anatomy from `sulcus anatomy` or `sulcus patient`"
    )
    parser.add_argument("--out", metavar="FILE.npz", type=Path, help="output file (default: ANATOMY.locator.npz)")
    parser.add_argument(
        "--small",
        action="store_true",
        help="store the open cortex and the tumour only, a tenth of the file: enough for scenes, `sulcus fit`, and "
        "`sulcus locate` without --out",
    )
    add_region_argument(parser, REGIONS)
    add_device(parser)
    add_seed(parser, "the causes that are drawn")
    add_force(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Build the locator of an anatomy, and write it to a file; return 0."""
    from sim.bodies.meshfile import read_anatomy
    from sim.runtime.device import find_device
    from surrogate.locating.locator_store import save_locator, to_locator_path
    from surrogate.locating.regions import describe_regions

    path = check_output_path(args.out or to_locator_path(args.anatomy), ".npz", args.force, [args.anatomy])
    check_integer("--seed", args.seed, 0)
    find_device(args.device, "float32")
    anatomy = read_anatomy(args.anatomy)
    locator = build_with_progress(path, anatomy, args.seed, args.device, list_regions_known(args, anatomy))
    save_locator(path, locator.restrict() if args.small else locator)
    remove_temporary_files(path)
    size = path.stat().st_size
    written = {"out": str(path), "shapes": len(locator.prior.shape), "bytes": size, "whole": not args.small}
    written["regions"] = [asdict(one) for one in locator.regions]
    beside = f"; knows {words}" if (words := describe_regions(locator.regions)) else ""
    print(json.dumps(written) if args.json else f"written: {path}, {size / 1e6:.1f} MB{beside}")
    return 0


def build_with_progress(path: Path, anatomy: Anatomy, seed: int, device: str, regions: tuple[Region, ...]) -> Locator:
    """Build a locator with a progress bar; parts of an interrupted run next to `path` are reused."""
    from tqdm import tqdm

    from surrogate.locating.causes import Causes
    from surrogate.locating.locator_store import make_locator

    print(f"sulcus: {path} takes minutes to build; if interrupted, run the command again to resume", file=sys.stderr)
    with tqdm(file=sys.stderr) as bar:

        def progress(stage: str, done: int, total: int) -> None:
            bar.total, bar.n = total, done
            bar.set_description(stage)

        return make_locator(
            anatomy, seed, device, Causes(regions=regions), folder=_to_parts_path(path), progress=progress
        )


def find_locator(args: argparse.Namespace, anatomy: Anatomy, allow_small: bool = False) -> Locator:
    """Load the requested locator or the locator next to the anatomy; build and save the locator if it does not exist.

    Raises
    ------
    InputError
        See `load_locator`; the locator has other regions than requested, or is small and `allow_small` is False.
    """
    from surrogate.locating.locator_store import load_locator, save_locator, to_locator_path
    from surrogate.locating.regions import describe_regions

    path = args.locator or to_locator_path(args.anatomy)
    if path.is_file():
        locator = load_locator(path, anatomy)
        if args.region and locator.regions != list_regions_known(args, anatomy):
            raise InputError(
                f"{path}: knows other regions than --region says ({describe_regions(locator.regions) or 'none'}). "
                "Leave --region out, or name another file by --locator: one that knows them is made there."
            )
        if locator.prior.nodes is not None and not allow_small:
            raise InputError(
                f"{path}: is small, and knows nothing of most vertices that a result has. Leave out --out for the "
                "tumour alone, or name another file by --locator: a whole one is made there."
            )
        return locator
    path = check_output_path(path, ".npz", args.force)
    locator = build_with_progress(path, anatomy, args.seed, args.device, list_regions_known(args, anatomy))
    save_locator(path, locator)
    remove_temporary_files(path)
    return locator


def list_regions_known(args: argparse.Namespace, anatomy: Anatomy) -> tuple[Region, ...]:
    """Return the regions of --region, or else the regions with a tissue in the models next to the anatomy.

    Raises
    ------
    InputError
        See `parse_region_tissues` and `list_known_regions`; also if a value is not a tissue.
    """
    from sim.effects import Elasticity
    from surrogate.locating.regions import list_known_regions
    from surrogate.model.store import read_learned_tissue

    from ..play.deformers import to_model_path

    if args.region:
        return list_known_regions(Elasticity(BRAIN, parse_region_tissues(args.region, BRAIN, anatomy.mesh)))
    models = to_model_path(Path(args.anatomy))
    learned = read_learned_tissue(models, anatomy) if models.is_file() else None
    return list_known_regions(learned) if learned is not None else ()


def remove_temporary_files(path: Path) -> None:
    """Remove the parts of an interrupted run next to a locator's path."""
    shutil.rmtree(_to_parts_path(path), ignore_errors=True)


def _to_parts_path(path: Path) -> Path:
    return path.with_suffix(".parts")
