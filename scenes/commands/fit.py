"""`sulcus fit`: estimate a patient's tissue from observations of the open cortex in several frames."""

from __future__ import annotations

import argparse
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sim.anatomy import TUMOUR_LABEL
from sim.errors import InputError
from sim.material import BRAIN

from ..options.outputs import add_force, check_output_path
from ..options.shared_options import add_device, add_json, add_seed, to_json_line
from ..options.tissue_options import add_region_argument, parse_region_tissues
from .locate import describe_excluded_rows
from .locator import REGIONS, find_locator

if TYPE_CHECKING:
    from surrogate.fitting.observed_frame import ObservedFrame
    from surrogate.fitting.tissue import FittedTissue


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument("anatomy", metavar="ANATOMY.vtu", help="anatomy from `sulcus anatomy` or `sulcus patient`")
    parser.add_argument(
        "frames", metavar="FRAME.csv", nargs="+",
        help="observations of each frame [mm, RAS]: `x,y,z,dx,dy,dz[,sigma]`, as `sulcus locate` reads it. "
        "A frame without tool is one with drained fluid",
    )  # fmt: skip
    parser.add_argument(
        "--tool-log", metavar="TOOLS.csv",
        help="pressing tools, columns `frame,x,y,z[,radius][,force[,sigma]]`: frame number from 1, tip and radius of "
        "the pressed disc [mm] (default: 6), measured force and its standard deviation [N], or empty cells",
    )  # fmt: skip
    parser.add_argument(
        "--rigid", type=float, default=0.8, metavar="MM",
        help="standard deviation of the rigid registration error of a frame, per axis [mm]",
    )  # fmt: skip
    parser.add_argument(
        "--out", type=Path, metavar="FILE.json",
        help="output file of the fitted tissue (default: ANATOMY.tissue.json, where `sulcus uncertainty` reads it)",
    )  # fmt: skip
    parser.add_argument(
        "--locator", metavar="FILE.npz", type=Path,
        help="ensemble as for `sulcus locate`; computed in minutes if missing (default: next to the anatomy)",
    )  # fmt: skip
    add_region_argument(parser, REGIONS)
    add_device(parser)
    add_seed(parser, "building a missing locator")
    add_force(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Fit the tissue to the observed frames, write it to a file, and print a summary; return 0."""
    from tqdm import tqdm

    from sim.bodies.meshfile import read_anatomy
    from sim.runtime.device import find_device
    from surrogate.fitting.fit import fit_tissue
    from surrogate.fitting.frame_likelihood import find_unsupported_points
    from surrogate.fitting.observed_frame import check_frames
    from surrogate.fitting.tissue import save_tissue, to_tissue_path

    out = check_output_path(args.out or to_tissue_path(args.anatomy), ".json", args.force, [args.anatomy, *args.frames])
    find_device(args.device, "float32")
    frames = _read_frames(args)
    anatomy = read_anatomy(args.anatomy)
    check_frames(anatomy, frames)  # reject invalid frames before a locator is built
    if TUMOUR_LABEL in parse_region_tissues(args.region, BRAIN, anatomy.mesh):
        raise InputError("--region tumour: its stiffness is what `sulcus fit` finds. Give other regions alone.")
    locator = find_locator(args, anatomy, allow_small=True)
    excluded = find_unsupported_points(locator, frames)
    with tqdm(file=sys.stderr) as bar:

        def progress(stage: str, done: int, total: int) -> None:
            bar.total, bar.n = total, done
            bar.set_description(stage)

        parts = Path(args.anatomy).with_suffix(".fit.parts")
        tissue = fit_tissue(locator, frames, args.device, parts, progress, excluded)
    save_tissue(out, tissue)
    shutil.rmtree(parts, ignore_errors=True)
    if args.json:
        print(to_json_line({**_summarise_tissue(tissue, out), "outliers": [each.tolist() for each in excluded]}))
    else:
        notes = [f"Frame {n}: {describe_excluded_rows(each)}" for n, each in enumerate(excluded, start=1) if len(each)]
        print("\n".join([*notes, *format_fit(tissue, out)]))
    return 0


def _read_frames(args: argparse.Namespace) -> list[ObservedFrame]:
    from surrogate.fitting.observed_frame import ObservedFrame, read_tools
    from surrogate.locating.observed_files import read_observation

    tools = ((),) * len(args.frames) if args.tool_log is None else read_tools(args.tool_log, len(args.frames))
    seen = [replace(read_observation(path), rigid=1e-3 * args.rigid) for path in args.frames]
    return [ObservedFrame(*each) for each in zip(seen, tools, strict=True)]


def _summarise_tissue(tissue: FittedTissue, out: Path) -> dict[str, object]:
    names = ("low", "median", "high")
    young = tissue.stiffness
    return {
        "ratio": dict(zip(names, tissue.ratio, strict=True)),
        "skull": tissue.skulls,
        "poisson": {**dict(zip(names, tissue.poisson, strict=True)), **tissue.classes},
        "young_pa": None if young is None else dict(zip(names, young, strict=True)),
        "not_known": tissue.not_known,
        "frames": tissue.frames,
        "of": "the patient's tissue: medians, and intervals that hold 95 % of the probability",
        "out": str(out),
    }


def format_fit(tissue: FittedTissue, out_path: Path) -> list[str]:
    """Describe the fitted parameters, and the parameters that the frames do not determine, as lines of text."""
    low, middle, high = tissue.ratio
    lines = [
        f"The tumour is {middle:.2g} times as stiff as the brain (95 %: {low:.2g} to {high:.2g}).",
        "Skull: " + ", ".join(f"{name} {share:.0%}" for name, share in tissue.skulls.items()) + ".",
        "Poisson's ratio: {1:.3f} (95 %: {0:.3f} to {2:.3f}); ".format(*tissue.poisson)
        + ", ".join(f"{name} {share:.0%}" for name, share in tissue.classes.items()) + ".",
    ]  # fmt: skip
    if tissue.stiffness is not None:
        low, middle, high = (1e-3 * each for each in tissue.stiffness)
        lines.append(f"Young's modulus of the brain is {middle:.2g} kPa (95 %: {low:.2g} to {high:.2g}).")
    lines += [f"Of {name} the frames say little: it is about as unknown as before." for name in tissue.not_known]
    return [*lines, f"written: {out_path}"]


def find_fitted_tissue(tissue_path: Path | None, anatomy_path: Path, digest: str) -> FittedTissue | None:
    """Read the fitted tissue from `tissue_path`, or from the file next to an anatomy; None if there is no file.

    Raises
    ------
    InputError
        See `load_tissue`; also if the requested file is missing.
    """
    from surrogate.fitting.tissue import load_tissue, to_tissue_path

    if tissue_path is not None and not tissue_path.is_file():
        raise InputError(f"{tissue_path}: no such file: make it by `sulcus fit`, or leave --tissue out.")
    where = tissue_path or to_tissue_path(anatomy_path)
    return load_tissue(where, digest) if where.is_file() else None
