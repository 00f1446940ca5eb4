"""`sulcus budget`: estimate the error budget of an overlay on a tracked camera, by source of error."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from sim.arguments import check_integer
from sim.errors import InputError
from sim.runtime.outside_files import wrap_errors

from ..options.camera_options import add_camera_options, use_tracked_camera
from ..options.patient_options import add_model_options, build_requested_scene
from ..options.shared_options import add_device, add_json, add_seed, to_json_line
from ..options.tissue_options import add_model_tissue

if TYPE_CHECKING:
    from ar.optics.calibration import Calibration

    from ..analysis.error_budget import ErrorBudget, FilmedScene, OverlayErrors
    from ..play.deformers import PatientSetup
    from ..script.priors import PatientSample
    from ..script.scene import Scene

    Bodies = list[tuple[PatientSample, tuple[np.ndarray, ...]]]

MIN_BODIES = 8  # Minimum number of bodies to solve.
MIN_SAMPLES = 200  # Minimum number of samples.
# Mean errors of overlays as published: a headset in 20 patients (10.3171/2025.5.JNS243160), and 35 studies [mm].
PUBLISHED_ERRORS = (2.2, 2.5)
# Explanation under the table.
NOTE = """
"across" and "along" the line of sight: error of the tumour's centre; "worst": maximum surface error, 95th percentile.
"technical": errors of camera, tracking, times and model; "clinical": also those of quantities that are not measured.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument(
        "scene",
        help="a built-in scene, see `sulcus scenes`, or MY_SCENE.py; palpate and retract take over 4 minutes on two "
        "cores",
    )
    add_model_options(parser)
    add_model_tissue(parser)
    add_camera_options(parser, "hand-held")
    parser.add_argument(
        "--intrinsics", type=Path, metavar="K.json",
        help="covariance of the intrinsics, from `sulcus calibrate` (default: of a calibration with 24 board views)",
    )  # fmt: skip
    parser.add_argument(
        "--registration", type=Path, metavar="R.json",
        help="from `sulcus register` (default: a published 1.56 mm along each axis)",
    )  # fmt: skip
    parser.add_argument("--corner-noise", type=float, default=0.1, help="standard deviation of a marker corner [pixel]")
    parser.add_argument(
        "--latency", type=float, default=0.0,
        help="delay between the tracked and the drawn image [ms]",
    )  # fmt: skip
    parser.add_argument("--time-noise", type=float, default=5.0, help="standard deviation of image and pose times [ms]")
    parser.add_argument(
        "--readout", type=float,
        help="readout time of a rolling shutter [ms] (default: `readout_time` of --camera, or none)",
    )  # fmt: skip
    parser.add_argument("--draws", type=int, default=24, help=f"number of bodies to solve, >= {MIN_BODIES}")
    parser.add_argument("--samples", type=int, default=1000, help="number of sampled errors")
    parser.add_argument("--twins", type=int, default=0, help="number of other bodies on which the band is tested")
    add_seed(parser, "the draws")
    add_device(parser, "finite elements")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Solve sampled bodies, sample errors, and report the contribution of each source; return 0.

    Raises
    ------
    InputError
        Unreadable files, numbers out of range, or a scene that cannot be solved.
    """
    from ..analysis.error_budget import FilmedScene, compute_budget, compute_velocity, find_largest_spread
    from ..analysis.uncertainty import sample_mesh_errors, solve_nominal, split_contributions
    from ..play.deformers import open_theatre
    from ..play.stage import Stage
    from ..tracked.filming import place_reference
    from ..tracked.registration_file import describe_other_mesh, read_registration

    check_integer("--draws", args.draws, MIN_BODIES)
    check_integer("--samples", args.samples, MIN_SAMPLES)
    check_integer("--twins", args.twins, 0)
    for name, value in (
        ("--corner-noise", args.corner_noise),
        ("--latency", args.latency),
        ("--time-noise", args.time_noise),
        ("--readout", args.readout or 0.0),
    ):
        if not 0.0 <= value < 1e4:
            raise InputError(f"{name} {value:g}: give a number that is not below 0.")
    patient = open_theatre(args.anatomy, args.model, args.device, [args.scene])
    scene = _build_filmed_scene(args, patient)
    calibration, site = scene.viewpoint.calibration, patient.site
    assert calibration is not None
    covariance = _read_intrinsic_covariance(args, calibration)
    registration = None
    if args.registration is not None:
        registration = read_registration(args.registration)
        describe_other_mesh(registration, patient.anatomy, args.registration)
    still = solve_nominal(patient, scene)
    bodies = _sample_bodies(args, patient, scene, args.draws, args.seed)
    draws = [draw for draw, _ in bodies]
    number = find_largest_spread(still, [answer for _, answer in bodies], sample_mesh_errors(scene, draws))
    time = still.times[number]
    own_bodies, meshes, own_mesh = _extract_motions_at(scene, bodies, number)
    filmed = FilmedScene(
        site=site, viewpoint=scene.viewpoint, duration=scene.duration, covariance=covariance, time=time,
        T_scan_patient=place_reference(site, scene.viewpoint.build_camera(site)),
        rest=Stage(scene, site).select_stage(scene.build_loads(site, scene.path(time), time)).tumour_at_rest.vertices,
        field=still.fields[number], normals=still.normals[number], velocity=compute_velocity(still, number),
        bodies=own_bodies, meshes=meshes, own_mesh=own_mesh, surrogate=_compute_model_bound(patient, scene, time),
        registration=registration, corner=args.corner_noise, latency=1e-3 * args.latency, clock=1e-3 * args.time_noise,
    )  # fmt: skip
    twins = None
    if args.twins:
        others, meshes, own_mesh = _extract_motions_at(
            scene, _sample_bodies(args, patient, scene, args.twins, args.seed + 1), number
        )
        twins = replace(filmed, bodies=others, meshes=meshes, own_mesh=own_mesh)
    bar = partial(tqdm, unit="part", desc="errors", leave=False, file=sys.stderr)
    found = compute_budget(filmed, args.samples, args.seed, twins, bar)
    report = _collect_figures(args, filmed, found, split_contributions(filmed.bodies, filmed.field, draws, scene))
    print(to_json_line(report) if args.json else "\n".join(_format_report(report)))
    return 0


def _build_filmed_scene(args: argparse.Namespace, patient: PatientSetup) -> Scene:
    """Build the requested scene with a calibrated, tracked camera.

    Raises
    ------
    InputError
        The scene has an observation model, the tissue has no priors, or the camera zooms.
    """
    from ..analysis.uncertainty import get_tissue

    scene = build_requested_scene(args, args.scene, patient)
    if scene.observation_model is not None:
        raise InputError(
            f"the scene {scene.name} estimates the tumour position and reports its error: choose another scene."
        )
    get_tissue(scene)
    filmed = use_tracked_camera(args, scene)
    calibration = filmed.viewpoint.calibration
    if args.readout is None or calibration is None:
        return filmed
    try:
        rolling = replace(calibration, readout=1e-3 * args.readout)
    except ValueError as error:
        raise InputError(f"--readout {args.readout:g}: {error}") from error
    return replace(filmed, viewpoint=replace(filmed.viewpoint, calibration=rolling))


def _read_intrinsic_covariance(args: argparse.Namespace, calibration: Calibration) -> np.ndarray:
    """Return the covariance (9, 9) of the camera's intrinsics, from --intrinsics or of a typical calibration.

    Raises
    ------
    InputError
        The file is missing, has no valid covariance, or belongs to another camera.
    """
    from ..analysis.tracking_errors import sample_usual_covariance

    path = args.intrinsics
    if path is None:
        return sample_usual_covariance(calibration)
    if args.camera is None:
        raise InputError("--intrinsics belongs to a camera: give it by --camera.")
    wanted = "Give the K.json that `sulcus calibrate` wrote next to the camera."
    with wrap_errors(path, "a covariance of intrinsics", wanted):
        stored = json.loads(path.read_text(encoding="utf-8-sig"))
        covariance, values = np.array(stored["covariance"], float), np.array(stored["values"], float)
        if covariance.shape != (9, 9) or not np.isfinite(covariance).all() or not (np.diag(covariance) >= 0.0).all():
            raise InputError(f"its covariance is none of nine parameters. {wanted}")
        if not np.allclose(values[:4], [*calibration.focal, *calibration.principal], rtol=1e-3):
            raise InputError(f"belongs to another camera or image size than --camera. {wanted}")
    return covariance


def _sample_bodies(args: argparse.Namespace, patient: PatientSetup, scene: Scene, count: int, seed: int) -> Bodies:
    """Sample bodies from the priors, and solve their tumour motions; bodies without equilibrium are dropped.

    Raises
    ------
    InputError
        Too few bodies have an equilibrium.
    """
    from ..analysis.uncertainty import filter_solved_samples, solve_ensemble
    from ..script.priors import sample_priors

    draws = sample_priors(count, seed, scene.elasticity.default)
    bar = tqdm(
        solve_ensemble(patient, scene, draws), total=count, unit="body", desc=scene.name, leave=False, file=sys.stderr
    )
    return filter_solved_samples(scene, draws, bar)


def _extract_motions_at(scene: Scene, bodies: Bodies, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return motions (b, n, 3) [m] at time index `number`, mesh errors (b,) of the bodies, and of the scene (b,)."""
    from ..analysis.uncertainty import find_mesh_prior, get_skull_model, sample_mesh_errors

    draws = [draw for draw, _ in bodies]
    own = find_mesh_prior(scene, get_skull_model(scene)).range[1] * np.array([draw.mesh for draw in draws])
    return np.stack([answer[number] for _, answer in bodies]), sample_mesh_errors(scene, draws), own


def _compute_model_bound(patient: PatientSetup, scene: Scene, time: float) -> float:
    """Compute the error bound [m] of a scene's deformation model at a time [s]; 0 for FEM."""
    player = patient.build_player(patient.select_default(scene), scene)
    number = int(np.abs(scene.times - time).argmin())
    return player.draw(number, time, scene.path(time)).model_error or 0.0


def _collect_figures(
    args: argparse.Namespace, filmed: FilmedScene, found: ErrorBudget, shares: dict[str, float]
) -> dict[str, Any]:
    """Collect the results for JSON, in millimetres and pixels."""
    from ..analysis.error_budget import PARAMETERS

    calibration, rows = (filmed.calibration, found.alone | {"technical": found.technical, "clinical": found.clinical})
    inside = {name: 1e3 * shares[name] for name in sorted(shares, key=lambda name: -shares[name]) if name not in rows}
    return {
        "scene": args.scene, "time_s": filmed.time,
        "moved_mm": 1e3 * float(np.linalg.norm(filmed.field, axis=1).mean()),
        "camera": {
            "width": calibration.width, "height": calibration.height, "focal_px": list(calibration.focal),
            "distance_mm": 1e3 * filmed.viewpoint.distance, "path": args.path or "stays",
        },
        "latency_ms": args.latency, "clock_ms": args.time_noise, "corner_px": args.corner_noise,
        "readout_ms": 1e3 * calibration.readout,
        "samples": args.samples, "bodies": len(filmed.bodies), "seed": args.seed,
        "parts": {name: _compute_quantiles(errors) for name, errors in rows.items()},
        "inside": {PARAMETERS: inside},
        "largest": {"middle": found.find_largest("middle"), "worst": found.find_largest("worst")},
        "band_mm": 1e3 * found.band, "held_twins": None if found.coverage is None else found.coverage[0],
        "held_twins_off": None if found.coverage is None else found.coverage[1],
        "published_mm": list(PUBLISHED_ERRORS),
    }  # fmt: skip


def _compute_quantiles(errors: OverlayErrors) -> dict[str, dict[str, float]]:
    """Compute the medians and 95th percentiles of errors [mm, pixel] for one row of the table."""
    columns = {
        "across_mm": 1e3 * errors.across, "along_mm": 1e3 * np.abs(errors.along), "pixels": errors.pixels,
        "middle_mm": 1e3 * errors.middle, "worst_mm": 1e3 * errors.worst,
    }  # fmt: skip
    quantiles = {name: np.quantile(values, [0.5, 0.95]).tolist() for name, values in columns.items()}
    return {name: {"p50": low, "p95": high} for name, (low, high) in quantiles.items()}


def _format_report(report: dict[str, Any]) -> list[str]:
    """Format the results as lines of text."""
    camera = report["camera"]
    lines = [
        f"{report['scene']} at {report['time_s']:.1f} s, the tumour has moved by {report['moved_mm']:.2f} mm. "
        f"Camera of {camera['width']} x {camera['height']}, {camera['distance_mm']:.0f} mm away, {camera['path']}.",
        "",
        f"{'p50, p95':<29}{'across [mm]':>14}{'along [mm]':>14}{'[pixel]':>14}{'worst point [mm]':>18}",
    ]
    for name, row in report["parts"].items():
        cells = [f"{row[key]['p50']:6.2f} {row[key]['p95']:6.2f}" for key in ("across_mm", "along_mm", "pixels")]
        lines.append(f"{name:<29}" + "".join(f"{cell:>14}" for cell in cells) + f"{row['worst_mm']['p95']:>18.2f}")
    lines += [
        NOTE,
        f"Largest part: {report['largest']['middle']} (centre), {report['largest']['worst']} (maximum).",
        f"In 95 % of the samples the maximum surface error is below {report['band_mm']:.1f} mm.",
    ]
    if report["held_twins"] is not None:
        off = report["held_twins_off"]
        about = "" if off is None else f" (+- {off:.1%}, from the variation between these bodies)"
        lines.append(f"On synthetic test cases with other errors, the coverage was {report['held_twins']:.1%}{about}.")
    low, high = report["published_mm"]
    place = "docs/notes/uncertainty_experiments.md"
    return [*lines, f"Published mean overlay errors: {low:g} to {high:g} mm ({place})."]
