"""`sulcus locator`: what is made once for an anatomy, so that any number of observations can be answered."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from sim.arguments import at_least
from sim.errors import InputError

from .outputs import add_force, claimed

if TYPE_CHECKING:
    from sim.anatomy import Anatomy
    from surrogate.locating.locator import Locator

KIND = "a locator of `sulcus locate`"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "anatomy", metavar="ANATOMY.vtu", type=Path, help="made by `sulcus anatomy` or `sulcus patient`"
    )
    parser.add_argument("--out", metavar="FILE.npz", type=Path, help="the locator (default: ANATOMY.locator.npz)")
    parser.add_argument(
        "--small",
        action="store_true",
        help="keep open cortex and tumour alone, a tenth of the file: enough for scenes, `sulcus fit`, and "
        "`sulcus locate` without --out",
    )
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda (default %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="from which causes are drawn (default %(default)s)")
    add_force(parser)
    parser.add_argument("--json", action="store_true", help="one JSON line instead of a sentence")


def run(args: argparse.Namespace) -> int:
    """Make the locator, whatever lies there already. 0: done."""
    from sim.bodies.meshfile import read_anatomy
    from sim.runtime.device import find_device
    from surrogate.locating.locator_files import locator_path, save_locator

    path = claimed(args.out or locator_path(args.anatomy), ".npz", KIND, args.force, [args.anatomy])
    at_least("--seed", args.seed, 0)
    find_device(args.device, "float32")
    anatomy = read_anatomy(args.anatomy)
    locator = made(path, anatomy, args.seed, args.device)
    save_locator(path, locator.small() if args.small else locator)
    forget_parts(path)
    size = path.stat().st_size
    written = {"out": str(path), "shapes": len(locator.prior.shape), "bytes": size, "whole": not args.small}
    print(json.dumps(written) if args.json else f"written: {path}, {size / 1e6:.1f} MB")
    return 0


def made(path: Path, anatomy: Anatomy, seed: int, device: str) -> Locator:
    """Make a locator, with a bar of progress; what a stopped run kept beside its `path` is not made again."""
    from tqdm import tqdm

    from surrogate.locating.setup import make_locator

    print(f"sulcus: {path} takes minutes to make; if it is stopped, the same command goes on", file=sys.stderr)
    with tqdm(file=sys.stderr) as bar:

        def progress(stage: str, done: int, total: int) -> None:
            bar.total, bar.n = total, done
            bar.set_description(stage)

        return make_locator(anatomy, seed, device, folder=_parts(path), progress=progress)


def located_by(args: argparse.Namespace, anatomy: Anatomy, small: bool = False) -> Locator:
    """The locator that lies beside the anatomy, or a new one; it knows every vertex, unless it may be `small`.

    Raises
    ------
    InputError
        As `load_locator`; a small one.
    """
    from surrogate.locating.locator_files import load_locator, locator_path, save_locator

    path = args.locator or locator_path(args.anatomy)
    if path.is_file():
        locator = load_locator(path, anatomy)
        if locator.prior.nodes is not None and not small:
            raise InputError(
                f"{path}: is small, and knows nothing of most vertices that a result has. Leave out --out for the "
                "tumour alone, or name another file by --locator: a whole one is made there."
            )
        return locator
    path = claimed(path, ".npz", KIND, args.force)
    locator = made(path, anatomy, args.seed, args.device)
    save_locator(path, locator)
    forget_parts(path)
    return locator


def forget_parts(path: Path) -> None:
    """Remove what was kept beside a locator's path while it was made."""
    shutil.rmtree(_parts(path), ignore_errors=True)


def _parts(path: Path) -> Path:
    return path.with_suffix(".parts")
