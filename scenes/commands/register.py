"""`sulcus register`: register a scan to the patient's reference from touched points, with covariance."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sim.errors import InputError

from ..options.outputs import add_force, check_output_path
from ..options.shared_options import add_json, to_json_line

if TYPE_CHECKING:
    from ar.tracking.registration import Nearest, PairResiduals, Registration
    from sim.anatomy import Anatomy


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument(
        "pairs", type=Path, metavar="PAIRS.csv",
        help="columns x,y,z,px,py,pz [mm]: a place in the scan, RAS, and where the tool's tip touched it, in the frame "
        "of the patient's reference",
    )  # fmt: skip
    parser.add_argument("--out", required=True, metavar="R.json", help="the registration")
    parser.add_argument("--anatomy", type=Path, metavar="P.vtu", help="anatomy: also estimate the error at its tumour")
    parser.add_argument(
        "--surface", type=Path, metavar="CLOUD.csv",
        help="points traced on the open cortex, in the frame of the reference; columns px,py,pz [mm]; needs --anatomy",
    )  # fmt: skip
    add_json(parser)
    add_force(parser)


def run(args: argparse.Namespace) -> int:
    """Register the scan, and write the registration; return 0.

    Raises
    ------
    InputError
        Files cannot be read or written, a surface is given without anatomy, or points determine no registration.
    """
    from ar.tracking.registration import compute_pair_residuals, refine_registration, register_points
    from sim import read_anatomy
    from surrogate.locating.observed_files import read_columns

    from ..tracked.registration_file import describe_scan, to_json, write_registration

    if args.surface is not None and args.anatomy is None:
        raise InputError("--surface is traced on an anatomy: give it by --anatomy.")
    out = check_output_path(args.out, ".json", args.force, [args.pairs, args.surface])
    columns = read_columns(args.pairs, {("x", "y", "z", "px", "py", "pz")})
    scan, patient = (1e-3 * np.column_stack([columns[name] for name in names]) for names in ("xyz", ("px", "py", "pz")))
    anatomy = None if args.anatomy is None else read_anatomy(args.anatomy)
    source = args.pairs if args.surface is None else f"{args.pairs}, {args.surface}"
    try:
        if args.surface is None or anatomy is None:
            found = register_points(scan, patient)
        else:
            traced = read_columns(args.surface, {("px", "py", "pz")})
            seen = 1e-3 * np.column_stack([traced[name] for name in ("px", "py", "pz")])
            found = refine_registration(scan, patient, seen, _build_nearest(anatomy))
        fits = compute_pair_residuals(scan, patient)
    except ValueError as error:
        raise InputError(f"{source}: {error}") from error
    found = found if anatomy is None else replace(found, scan=describe_scan(anatomy))
    write_registration(out, found)
    target = None if anatomy is None else _compute_tumour_error(found, anatomy)
    if args.json:
        figures = {} if target is None else {"tumour_p95_mm": 1e3 * target[1], "along_mm": target[0].tolist()}
        print(to_json_line({"out": str(out), **to_json(found), **figures, **_summarise_residuals(fits)}))
        return 0
    print("\n".join(_format_table(fits)))
    print(f"{found.pair_count} pairs fit to {1e3 * found.rms:.2f} mm (rms); that is not the error at the tumour")
    if target is None:
        print("give --anatomy for that error")
    if target is not None:
        print(f"the tumour's middle is within {1e3 * target[1]:.1f} mm in the patient's frame (95 %), by these points")
    print(f"written: {out}")
    return 0


def _summarise_residuals(fits: PairResiduals) -> dict[str, object]:
    """Summarise the residuals of the pairs for JSON."""
    return {
        "residuals_mm": (1e3 * fits.residuals).tolist(),
        "left_out_mm": (1e3 * fits.held_out).tolist(),
        "studentised": fits.studentised.tolist(),
        "worst_pair": fits.worst_pair + 1,
        "chance": fits.p_value,
        "suspect": fits.has_outlier,
    }


def _format_table(fits: PairResiduals) -> list[str]:
    """Format the residuals as a row for each pair, and a warning if the worst pair may be an outlier."""
    if np.isnan(fits.p_value):
        rows = [f"{row + 1:4d} {1e3 * off:7.2f} mm" for row, off in enumerate(fits.residuals)]
        return ["pair    error", *rows, "three pairs cannot show an outlier: touch a fourth, better six"]
    lines = ["pair    error      held-out error   studentised error"]
    for row, (off, left, times) in enumerate(zip(fits.residuals, fits.held_out, fits.studentised, strict=True)):
        lines.append(f"{row + 1:4d} {1e3 * off:5.2f} mm {1e3 * left:16.2f} mm {times:17.1f} x")
    worst = fits.worst_pair
    if fits.has_outlier:
        lines.append(
            f"pair {worst + 1} may be an outlier: it is {1e3 * fits.held_out[worst]:.1f} mm from the others' fit. "
            f"{100.0 * fits.p_value:.2g} % of sets without outliers have this residual. Touch it again, or leave it out"
        )
    return lines


def _build_nearest(anatomy: Anatomy) -> Nearest:
    """Build a function from points (n, 3) [m] to the nearest points on the brain's surface, and the normals there."""
    from sim.geometry.closest_point import find_closest_points

    corners = anatomy.mesh.nodes[anatomy.mesh.surface]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    def find_nearest(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = find_closest_points(points, corners)
        return found.point, normals[found.triangle]

    return find_nearest


def _compute_tumour_error(registration: Registration, anatomy: Anatomy) -> tuple[np.ndarray, float]:
    """Compute the tumour centroid's error: deviations (3,) [mm] along the reference's axes, and 95 % radius [m]."""
    from surrogate.locating.locator import compute_confidence_radius

    if not len(anatomy.tumour_nodes):
        raise InputError("the anatomy has no tumour: leave out --anatomy, or give one with a tumour.")
    _, covariance = registration.transform_point(anatomy.mesh.nodes[anatomy.tumour_nodes].mean(axis=0))
    return 1e3 * np.sqrt(np.diag(covariance)), compute_confidence_radius(covariance)
