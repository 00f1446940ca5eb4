"""`sulcus warp`: write a deformed brain as fields, images, meshes and markups for other programs."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sim.errors import InputError

from ..options.patient_options import add_trajectory, build_requested_scene
from ..options.shared_options import add_device, add_json, to_json_line
from ..options.subject_options import add_axes
from ..options.tissue_options import add_model_tissue, apply_tissue_options

if TYPE_CHECKING:
    from ..play.deformers import PatientSetup
    from ..script.scene import Scene
    from ..warp.deformed_anatomy import DeformedAnatomy

ORDERS = ("linear", "cubic")  # Interpolations of images.
MAX_FORCE = 20.0  # Largest accepted force [N]: more is a typing error.
MAX_DISTANCE = 20.0  # Largest accepted distance from the open cortex [mm]: more is a typing error.


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument(
        "anatomy", nargs="?", type=Path, metavar="PATIENT.vtu",
        help="anatomy from `sulcus anatomy` or `sulcus patient` (default: the template that ships)",
    )  # fmt: skip
    cause = parser.add_mutually_exclusive_group(required=True)
    cause.add_argument("--scene", metavar="NAME", help="built-in scene or MY_SCENE.py, solved by FEM at one frame")
    cause.add_argument(
        "--load", type=parse_load, metavar="X,Y,Z,N",
        help="force [N] of a round tool that presses inwards on the open cortex nearest to a point [mm, RAS]",
    )  # fmt: skip
    cause.add_argument(
        "--located", type=Path, metavar="RESULT.vtu",
        help="result of `sulcus locate`, with the covariance of the tumour position, or of `sulcus solve`",
    )  # fmt: skip
    parser.add_argument("--frame-number", type=int, metavar="K", help="frame number of --scene")
    parser.add_argument(
        "--sequence", type=int, metavar="EVERY",
        help="also write the forward field of every Nth frame of the scene, as a sequence for 3D Slicer",
    )  # fmt: skip
    parser.add_argument(
        "--image", type=Path, nargs="+", action="extend", default=[], metavar="T1.nii.gz",
        help="images of the patient, in the space of the label map of the anatomy",
    )  # fmt: skip
    add_axes(parser)
    parser.add_argument(
        "--label-maps", type=Path, nargs="+", action="extend", default=[], metavar="LABELS.nii.gz",
        help="label maps in the same space; resampled with nearest neighbour",
    )  # fmt: skip
    parser.add_argument("--interpolation", choices=ORDERS, default=ORDERS[0], help="interpolation of images")
    parser.add_argument(
        "--spacing", type=float, metavar="MM",
        help="grid spacing, 0.3 to 5 mm (default: 1, or finer until tumour and landmarks are within 0.05 mm)",
    )  # fmt: skip
    parser.add_argument("--out", required=True, type=Path, metavar="DIR", help="new output folder")
    add_trajectory(parser)
    add_model_tissue(parser)
    add_device(parser, "FEM")
    add_json(parser)


def parse_load(text: str) -> tuple[float, float, float, float]:
    """Parse the text X,Y,Z,N into a point [mm] and a force [N], for argparse."""
    try:
        x, y, z, newton = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a place and a force such as -30,12.5,60,0.3") from None
    return x, y, z, newton


def run(args: argparse.Namespace) -> int:
    """Solve the load, write the files, and report; return 1 if the solution did not converge or the field folds."""
    from tqdm import tqdm

    from sim.runtime.atomic_files import write_folder_atomically

    from ..play.deformers import open_theatre
    from ..script.scene import check_scene_exists
    from ..script.shipped_files import get_template_path
    from ..warp.export import WarpSettings, write_warp
    from ..warp.images import read_patient_image
    from ..warp.places import count_steps

    check_warp_options(args)
    if args.scene is not None:
        check_scene_exists(args.scene)
    with write_folder_atomically(args.out) as place:
        patient = open_theatre(args.anatomy, None, args.device)
        scene = None if args.located else build_scene(args, patient)
        pictures = [
            read_patient_image(path, patient.anatomy, path in args.label_maps, args.axes)
            for path in (*args.image, *args.label_maps)
        ]
        for picture in pictures:
            for warning in picture.warnings:
                print(f"{picture.path}: {warning}", file=sys.stderr)
        moment, sequence = select_deformed_anatomies(args, patient, scene)
        source = (args.anatomy or get_template_path()).name
        spacing = None if args.spacing is None else 1e-3 * args.spacing
        total = count_steps(spacing) + 2 + len(pictures) + bool(sequence)
        with tqdm(total=total, unit="part", desc="fields, files", file=sys.stderr) as bar:
            asked = WarpSettings(spacing, args.interpolation, source, bar.update)
            report = write_warp(place, moment, pictures, asked, sequence)
    for warning in report["warnings"]:
        print(f"sulcus warp: {warning}", file=sys.stderr)
    print(to_json_line({**report, "out": str(args.out)}) if args.json else format_warp(report, args.out))
    wrong = "" if report["converged"] else "the solution did not converge"
    if report["fields_fold"]:
        wrong = "the displacement field folds: see README.txt"
    if wrong:
        print(f"sulcus warp: {wrong}: do not rely on what was written", file=sys.stderr)
    return 1 if wrong else 0


def check_warp_options(args: argparse.Namespace) -> None:
    """Check the options for conflicts and for values out of range.

    Raises
    ------
    InputError
        An option is missing, unused or invalid, or two images have the same output name.
    """
    from ..warp.images import to_warped_name
    from ..warp.places import MAX_SPACING, MIN_SPACING

    if args.spacing is not None and not 1e3 * MIN_SPACING <= args.spacing <= 1e3 * MAX_SPACING:
        raise InputError(f"--spacing {args.spacing:g}: give {1e3 * MIN_SPACING:g} to {1e3 * MAX_SPACING:g} mm.")
    if args.scene is None and (args.frame_number is not None or args.sequence is not None):
        raise InputError("--frame-number and --sequence are of a --scene: give one, or leave them out.")
    if args.scene is None and args.trajectory is not None:
        raise InputError("--trajectory is of a --scene: a --load has its own place. Leave one of them out.")
    if args.scene is not None and args.frame_number is None:
        raise InputError("--frame-number: say which moment of the scene, by its number; `sulcus demo` shows them.")
    names = [to_warped_name(path) for path in (*args.image, *args.label_maps)]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two images would both become {name}. Rename one, or warp them one after the other.")


def build_scene(args: argparse.Namespace, patient: PatientSetup) -> Scene:
    """Return the requested scene; for --load, a scene with a tool that pushes constantly.

    Raises
    ------
    InputError
        The scene or frame is unknown, the force is not positive or too large, or the point is not on the cortex.
    """
    if args.load is not None:
        return apply_tissue_options(args, replace(build_pushing_scene(patient, args.load), name="load"), patient)
    scene = build_requested_scene(args, args.scene, patient)
    last = len(scene.times) - 1
    if not 0 <= args.frame_number <= last:
        raise InputError(f"--frame-number {args.frame_number}: {scene.name} has the frames 0 to {last}.")
    if args.sequence is not None and not 1 <= args.sequence <= last:
        raise InputError(f"--sequence {args.sequence}: must be between 1 and {last} (exports every Nth frame).")
    return scene


def build_pushing_scene(patient: PatientSetup, load: tuple[float, float, float, float]) -> Scene:
    """Return a scene with a round tool that pushes the open cortex constantly; `load` is X, Y, Z [mm, RAS], force [N].

    Raises
    ------
    InputError
        See `build_scene`.
    """
    from ..script.scene import find_scene
    from ..script.tool_paths import Touch

    *place, newton = load
    if not 0.0 < newton <= MAX_FORCE:
        raise InputError(f"--load: a force of {newton:g} N is no push on a brain; give 0 to {MAX_FORCE:g} N.")
    point, site = 1e-3 * np.array(place), patient.site
    nearest = site.find_nearest(point).point if np.isfinite(point).all() else np.full(3, np.inf)
    apart = 1e3 * float(np.linalg.norm(nearest - point))
    if not apart <= MAX_DISTANCE:
        middle = ", ".join(f"{1e3 * value:.0f}" for value in site.origin)
        raise InputError(
            f"--load: the place is {apart:.0f} mm from the open cortex; {MAX_DISTANCE:g} mm is the most. The middle "
            f"of the open cortex is at {middle} mm (RAS)."
        )
    arm = nearest - site.origin
    touch = Touch(float(arm @ site.right), float(arm @ site.up), newton)
    return replace(find_scene("press"), path=lambda time: touch, duration=1.0, frames_per_second=1.0)


def select_deformed_anatomies(
    args: argparse.Namespace, patient: PatientSetup, scene: Scene | None
) -> tuple[DeformedAnatomy, list[tuple[float, DeformedAnatomy]]]:
    """Return the requested deformed anatomy, and those of --sequence with times [s]; without a scene, read --located.

    Raises
    ------
    InputError
        See `read_deformed_anatomy`.
    """
    from tqdm import tqdm

    from ..warp.deformed_anatomy import PlayedScene, read_deformed_anatomy

    if scene is None:
        return read_deformed_anatomy(args.located, patient.anatomy), []
    wanted = args.frame_number or 0
    many = [] if args.sequence is None else list(range(0, len(scene.times), args.sequence))
    frames = sorted({wanted, *many})
    with tqdm(total=frames[-1] + 1, unit="frame", desc="finite elements", file=sys.stderr) as bar:
        played = PlayedScene(patient, scene, args.load is not None)
        found = dict(zip(frames, played.solve_frames(frames, bar.update), strict=True))
    return found[wanted], [(float(scene.times[number]), found[number]) for number in many]


def format_warp(report: dict, out_path: Path) -> str:
    """Format the report of `write_warp` as lines of text."""
    error, bound = report["grid_error_mm"], report["bound_mm"]
    lines = [
        f"Moved by: {report['moved_by']}. The largest displacement is {report['largest_displacement_mm']:.2f} mm.",
        f"On a grid of {report['spacing_mm']:g} mm the maximum error of the tumour relative to FEM is "
        f"{error['tumour']['worst']:.3f} mm, of the open cortex {error['cortex']['worst']:.3f} mm.",
        f"The tumour position error in the patient is not available: {report['bound_of']}."
        if bound is None
        else f"Tumour position error in the patient (95 %): maximum surface error {bound:.1f} mm.",
    ]
    for image in report["images"]:
        lost = image["outside"] + image["resected"]
        lines.append(f"{image['name']}: {image['moved']:,} voxels moved, {lost:,} without source data are set to 0.")
    return "\n".join([*lines, f"Written to {out_path}; README.txt there says how to open it."])
