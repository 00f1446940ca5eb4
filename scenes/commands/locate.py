"""`sulcus locate`: estimate the tumour position, with covariance, from observations of the open cortex."""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sim.anatomy import name_region
from sim.arguments import check_integer

from ..options.outputs import add_force, check_output_path
from ..options.shared_options import add_device, add_json, add_seed, to_json_line
from ..options.tissue_options import add_region_argument
from .locator import REGIONS, find_locator

if TYPE_CHECKING:
    from surrogate.locating.locator import Location
    from surrogate.locating.regions import Region


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument("anatomy", metavar="ANATOMY.vtu", help="anatomy from `sulcus anatomy` or `sulcus patient`")
    parser.add_argument(
        "observed", metavar="OBSERVED.csv",
        help="observations [mm, RAS], with a header. `x,y,z,dx,dy,dz`: points in the scan, such as vessels, "
        "and their observed displacements; `x,y,z`: point cloud of the deformed open cortex. Optional last column "
        "`sigma`: standard deviation of the non-rigid error per axis [mm] (default: 0.58)",
    )  # fmt: skip
    parser.add_argument(
        "--tips", metavar="TIPS.csv", help="contact points of tools on the cortex [mm], columns `x,y,z`"
    )
    parser.add_argument(
        "--rigid", type=float, default=0.8, metavar="MM",
        help="standard deviation of the rigid registration error per axis [mm], with a proportional rotation",
    )  # fmt: skip
    parser.add_argument(
        "--registration-checked", action="store_true",
        help="registration verified on fixed landmarks: assume no registration shift beyond --rigid",
    )  # fmt: skip
    parser.add_argument(
        "--out", metavar="RESULT.vtu",
        help="file for mean displacement and covariance of every vertex (default: none; the tumour alone is reported, "
        "and a small locator is enough)",
    )  # fmt: skip
    parser.add_argument(
        "--locator", metavar="FILE.npz", type=Path,
        help="ensemble of motions of the anatomy; computed in minutes if missing (default: next to the anatomy)",
    )  # fmt: skip
    add_region_argument(parser, REGIONS)
    add_device(parser, "building a missing locator")
    add_seed(parser, "a locator that is made; without effect where there is one")
    add_force(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Locate the tumour and report the result; return 0. Raise InputError for observations that no cause explains."""
    from sim.bodies.meshfile import read_anatomy, write_mesh
    from sim.runtime.device import find_device
    from surrogate.locating.observation import to_evidence
    from surrogate.locating.observed_files import read_observation

    out = None if args.out is None else check_output_path(args.out, ".vtu", args.force, [args.anatomy])
    check_integer("--seed", args.seed, 0)
    find_device(args.device, "float32")
    anatomy = read_anatomy(args.anatomy)
    observation = replace(
        read_observation(args.observed, args.tips), rigid=1e-3 * args.rigid, checked=args.registration_checked
    )
    to_evidence(anatomy, observation)  # reject points that cannot be placed before the locator is loaded
    locator = find_locator(args, anatomy, allow_small=out is None)
    found = locator.locate(observation)
    if out is not None:
        every = np.arange(len(anatomy.mesh.nodes))
        covariance = found.compute_covariance(every)
        fields = {
            "displacement": found.compute_motion(every),
            "deviation": np.sqrt(np.maximum(np.trace(covariance, axis1=1, axis2=2), 0.0)),
            "covariance": covariance[:, [0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]],
        }
        write_mesh(out, anatomy.mesh, fields, "RAS")
    if args.json:
        print(to_json_line(_summarise(found, len(observation.now), locator.regions, out)))
    else:
        print(_format_result(found, out))
    return 0


def _summarise(result: Location, point_count: int, regions: tuple[Region, ...], out: Path | None) -> dict[str, object]:
    return {
        "centroid_mm": (1e3 * result.centroid).tolist(),
        "covariance_mm2": (1e6 * result.centroid_covariance).tolist(),
        "p95_mm": 1e3 * result.p95,
        "explained": result.explained,
        "explained_by_rigid_error": result.rigid_alone.share,
        "causes": result.causes,
        "cause_groups": [asdict(share) for share in result.cause_shares],
        "within_errors": result.within_errors,
        "bias_mm": (1e3 * result.bias).tolist(),
        "bias_degrees": np.degrees(result.rotation).tolist(),
        "points": point_count,
        "outliers": result.outliers.tolist(),
        "tips_left_out": result.outlier_tips.tolist(),
        "slipped": result.slipped,
        "calibrated": result.calibrated,
        "warnings": _list_warnings(result),
        "regions": {name_region(one.label): one.ratio for one in regions},
        "milliseconds": 1e3 * result.seconds,
        "of": "the tumour, as far as the causes that were tried go; not of a model",
        "out": None if out is None else str(out),
    }


def _format_result(result: Location, out: Path | None) -> str:
    x, y, z = (round(value, 1) + 0.0 for value in 1e3 * result.centroid)  # + 0.0 turns -0.0 into 0.0
    sure = "With a probability of 95 %" if result.calibrated else "As a rough estimate"
    lines = [
        f"The centre of the tumour has moved by {x:.1f}, {y:.1f}, {z:.1f} mm (right, anterior, superior).",
        f"{sure} its error is at most {1e3 * result.p95:.1f} mm.",
        f"The estimate explains {100 * result.explained:.0f} % of the observed motion (mean square).",
        f"Causes of the motion: {result.named_causes}.",
        f"Estimated registration shift of the observation: {1e3 * sum(result.bias**2) ** 0.5:.1f} mm.",
    ]
    lines += _list_warnings(result)
    return "\n".join(lines if out is None else [*lines, f"written: {out}"])


def _list_warnings(found: Location) -> list[str]:
    """List the warnings of a result as sentences, including excluded points and tips."""
    warnings = list(found.warnings)
    if found.slipped:
        warnings.append("If it was checked, say so by --registration-checked.")
    if len(found.outliers):
        warnings.append(describe_excluded_rows(found.outliers))
    return warnings + [f"Left out, as the points do not support it: tip {number + 1}." for number in found.outlier_tips]


def describe_excluded_rows(indices: np.ndarray) -> str:
    """Describe the excluded rows of a file, given the indices (k,) of their points."""
    rows = ", ".join(str(number + 2) for number in indices[:20]) + (" ..." if len(indices) > 20 else "")
    return f"Left out, off the open cortex or without support by other points: rows {rows} of the file."
