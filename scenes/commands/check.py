"""`sulcus check`: play the built-in scenes without display, and compare metrics of their images with limits."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TextIO

from sim.arguments import check_integer

from ..options.camera_options import add_camera_options, apply_camera_options
from ..options.patient_options import add_patient, build_requested_scene, choose_deformer, list_playable, open_patient
from ..options.shared_options import add_json, add_style

if TYPE_CHECKING:
    from ..play.checks import SceneFigures
    from ..play.deformers import PatientSetup
    from ..play.player import Frame
    from ..script.scene import Scene
    from ..script.uncertainty import TumourError


TRACKING = "tracking"  # Name of the check without a scene: a synthetic video whose markers disappear and return.


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument(
        "scenes", nargs="*",
        help="built-in scenes, or MY_SCENE.py; tracking: a synthetic video with markers that disappear (default: all)",
    )  # fmt: skip
    parser.add_argument("--every", type=int, default=10, help="check every Nth frame")
    add_patient(parser)
    add_camera_options(parser)
    add_style(parser, excluded_styles=("none",))  # the check needs an outline in the image
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Check each requested scene and the tracking; return 1 if a metric exceeds its limit, else 0."""
    from tqdm import tqdm

    from ..play.checks import list_warnings, measure_frames
    from ..play.frame_text import format_errors
    from ..play.reference import solve_reference_frames
    from ..script.scene import SCENES

    check_integer("--every", args.every, 1)
    asked = args.scenes or [*SCENES, TRACKING]
    names = [name for name in asked if name != TRACKING]
    patient = open_patient(args, *names)
    scenes = [apply_camera_options(args, build_requested_scene(args, name, patient)) for name in names]
    scenes = list_playable(args, patient, scenes)
    rows, table = [], sys.stderr if args.json else sys.stdout
    for scene in scenes:
        name = choose_deformer(args, patient, scene)
        player = replace(patient.build_player(name, scene), style=args.style)
        print(f"{scene.name} by {patient.describe_deformer(name, scene)}", file=table)
        total = len(scene.times[:: args.every])
        with tqdm(total=2 * total, unit="frame", desc=scene.name, leave=False, file=sys.stderr) as bar:
            frames = []
            for frame in player.play_frames(args.every):
                frames.append(frame)
                bar.update()
            truth = solve_reference_frames(patient, scene, [frame.loads for frame in frames], bar.update)
        figures = measure_frames(player, player.get_camera, frames, truth)
        broken = figures.find_violations(scene.bounds)
        played = {"scene": scene.name, "deformer": name, "solver": patient.describe_deformer(name, scene)}
        promised, error = _find_largest_errors(frames)
        rows.append({**played, "frames": len(frames), **figures.to_row(), "broken": broken})
        against = list_warnings(frames)
        rows[-1] |= {
            "model_error_mm": _to_millimetres(promised),
            "tumour_error_mm": _to_millimetres(error.bound),
            "largest_part": error.main_source,
            "tumour_error_is_a_guess": error.is_rough,
            "objections": against,
            "tumour_error_unobserved_mm": _to_millimetres(error.prior),
        }
        print(
            f"{scene.name:11s} {'FAILS' if broken else 'passes'}  {_describe_comparison(scene, name)}: error "
            f"{figures.error_mm:.3f} "
            f"mm at a motion of {figures.motion_mm:.2f} mm. Outline error {figures.drawn:.1f} px, "
            f"overlap {figures.overlap:.3f} (1 is best). {figures.leaked:.0%} leaks out of the "
            f"skull{_describe_bond(figures.bond)}{_summarise_estimates(figures)}",
            file=table,
        )
        for sentence in format_errors(promised, error, name != "fem", figures=player.recorded):
            print(f"{'':11s} {sentence}", file=table)
        for sentence in (*broken, *against):
            print(f"{'':11s} {sentence}", file=table)
    tracking = _check_tracking(args, patient, table) if TRACKING in asked else None
    passed = not any(row["broken"] for row in (*rows, *([] if tracking is None else [tracking])))
    if args.json:
        print(json.dumps({"passed": passed, "scenes": rows, "tracking": tracking}))
    return 0 if passed else 1


def _check_tracking(args: argparse.Namespace, patient: PatientSetup, stream: TextIO) -> dict[str, object]:
    """Check the overlay on a synthetic video whose markers disappear and return; return metrics for JSON."""
    from ..tracked.rendered_video import render_synthetic_video
    from ..tracked.tracking_checks import build_default_pipeline, measure_tracking

    film = render_synthetic_video(patient)
    figures = measure_tracking(film, *build_default_pipeline(film, args.style))
    broken = figures.find_violations()
    print(
        f"{TRACKING:11s} {'FAILS' if broken else 'passes'}  markers covered; images repeated, late and missing: "
        f"{figures.confident} of {figures.pictures} images draw a lost or old position as valid, {figures.unsaid} do "
        f"not report it. Error of valid positions {figures.off:.1f} px; valid again after {figures.back:g} images",
        file=stream,
    )
    for sentence in broken:
        print(f"{'':11s} {sentence}", file=stream)
    return {**figures.to_row(), "broken": broken}


def _find_largest_errors(frames: Sequence[Frame]) -> tuple[float | None, TumourError]:
    """Return the maxima over a scene's frames: error bound of the model [m], and tumour position error."""
    from ..play.frame_text import find_largest

    promised = [frame.model_error for frame in frames if frame.model_error is not None]
    return max(promised, default=None), find_largest([frame.tumour_error for frame in frames])


def _to_millimetres(metres: float | None) -> float | None:
    return None if metres is None else 1e3 * metres


def _describe_comparison(scene: Scene, name: str) -> str:
    """Describe the compared tumour: that of a deformation model, or the tumour estimated from observations."""
    return f"{name}: the tumour" if scene.observation_model is None else f"{name} is the reference; tumour estimate"


def _describe_bond(strength_ratio: float) -> str:
    """Describe the largest traction of the bond to the skull as a share of its strength; empty without bond."""
    return f", bond at {strength_ratio:.0%} of its strength" if math.isfinite(strength_ratio) else ""


def _summarise_estimates(figures: SceneFigures) -> str:
    """Describe coverage and accuracy of the estimates in a scene with observations; empty without estimates."""
    if not math.isfinite(figures.covered):
        return ""
    held = f"Its middle is in the ellipsoid in {figures.covered:.0%} of the frames"
    return f". {held}; estimates remove {figures.removed:.0%} of its motion"
