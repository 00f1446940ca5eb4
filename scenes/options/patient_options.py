"""Command-line options of commands that play a scene: anatomy, models, solver, tissue and trajectory."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sim.errors import InputError

from ..script.registration import REGISTRATIONS
from .shared_options import add_anatomy, add_device
from .tissue_options import add_model_tissue, apply_tissue_options

if TYPE_CHECKING:
    from ..play.deformers import PatientSetup
    from ..script.craniotomy_frame import CraniotomyFrame
    from ..script.scene import Scene


def add_model_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of anatomy, models and trajectory to a parser."""
    add_anatomy(parser)
    parser.add_argument(
        "--model", type=Path,
        help="trained models from `sulcus train`, .npz (default: MESH.model.npz next to the anatomy)",
    )  # fmt: skip
    add_trajectory(parser)


def add_trajectory(parser: argparse.ArgumentParser) -> None:
    """Add the option --trajectory to a parser."""
    parser.add_argument(
        "--trajectory", type=Path, metavar="LINE.mrk.json",
        help="line from 3D Slicer along which the tool enters the open cortex, or a point, where it enters straight "
        "inwards (default: the centre of the craniotomy)",
    )  # fmt: skip


def add_patient(parser: argparse.ArgumentParser) -> None:
    """Add the options of anatomy, deformer, registration, tissue and device to the parser of a command with scenes."""
    add_model_options(parser)
    parser.add_argument(
        "--deformer",
        help="deformation model: a trained one (linear, ann, svr, ...); fem; a family of models (condensed, ...); "
        "guarded: the best trained model with FEM where it is unreliable; auto: chosen by --within-error or "
        "--within-time (default: the model with the smallest error)",
    )
    parser.add_argument(
        "--guard", type=float, metavar="MM",
        help="bound (95 %%) of the tumour's surface error above which guarded uses FEM [mm] (default: 0.2)",
    )  # fmt: skip
    budget = parser.add_argument_group("budget, instead of --deformer; errors as reported by models, or recorded")
    budget.add_argument(
        "--within-error", type=float, metavar="MM",
        help="use the fastest deformation model whose reported error is at most this [mm]",
    )  # fmt: skip
    budget.add_argument(
        "--within-time", type=float, metavar="MS",
        help="use the most accurate deformation model that needs at most this per frame [ms]",
    )  # fmt: skip
    parser.add_argument(
        "--registration", choices=tuple(REGISTRATIONS),
        help="registration of the scan to the patient; clinical: standard deviation of 1.6 mm per axis (default: the "
        "scene's, perfect in built-in scenes)",
    )  # fmt: skip
    add_model_tissue(parser)
    add_device(parser, "FEM")


def open_patient(args: argparse.Namespace, *scenes: str) -> PatientSetup:
    """Open the anatomy and the models that the options of `add_patient` request; `scenes` are names of scenes.

    Raises
    ------
    InputError
        See `open_theatre`; also if --guard is not positive.
    """
    from ..play.deformers import open_theatre

    patient = open_theatre(args.anatomy, args.model, args.device, scenes)
    if args.guard is None:
        return patient
    if not 0.0 < args.guard < float("inf"):
        raise InputError(f"--guard {args.guard:g}: give a positive number of millimetres, or leave it out.")
    return replace(patient, limit=1e-3 * args.guard)


def build_requested_scene(args: argparse.Namespace, name: str, patient: PatientSetup) -> Scene:
    """Return a scene by name, with registration, tissue, element type and trajectory from the options if given.

    Raises
    ------
    InputError
        See `find_scene`, `apply_tissue_options`, `read_markup` and `parse_approach`.
    """
    from ..script.scene import find_scene

    scene = find_scene(name)
    if getattr(args, "registration", None) is not None:
        scene = replace(scene, registration=args.registration)
    scene = apply_tissue_options(args, scene, patient)
    return scene if args.trajectory is None else _follow_trajectory(args, scene, patient.site)


def _follow_trajectory(args: argparse.Namespace, scene: Scene, site: CraniotomyFrame) -> Scene:
    """Return the scene with its tool on the trajectory; print a notice if the bone's edge stops the tool."""
    from sim.bodies.markups import read_markup

    from ..script.approach import parse_approach
    from ..script.tool_paths import keep_idle

    approach = parse_approach(read_markup(args.trajectory), site)
    if scene.tool is None:
        print(f"{args.program}: {scene.name} has no tool that could follow {args.trajectory}", file=sys.stderr)
        return scene
    stopped = scene.describe_stop(site, approach.shift_path(keep_idle)(0.0))
    if stopped:
        print(f"{args.program}: where {args.trajectory} enters, {stopped}", file=sys.stderr)
    return replace(scene, path=approach.shift_path(scene.path), tool=approach.align_tool(scene.tool))


def list_playable(args: argparse.Namespace, patient: PatientSetup, scenes: Sequence[Scene]) -> list[Scene]:
    """Return the requested scenes; by default all scenes except those that need a missing locator (with a notice)."""
    left = [] if args.scenes else [scene for scene in scenes if patient.is_without_locator(scene)]
    if left:
        names = ", ".join(scene.name for scene in left)
        message = f"no {names}: this anatomy has no locator. Make one with `sulcus locator`"
        print(f"{args.program}: {message}", file=sys.stderr)
    return [scene for scene in scenes if scene not in left]


def choose_deformer(args: argparse.Namespace, patient: PatientSetup, scene: Scene, default: str | None = None) -> str:
    """Return the name of the requested deformation model; a choice by a budget is printed with its reason.

    `default`: name without a request; None: the default of the scene.

    Raises
    ------
    InputError
        Both a deformer and a budget are given, or no model meets the budget.
    """
    budget = args.within_error, args.within_time
    if args.deformer != "auto" and budget == (None, None):
        if asked := args.deformer or default:
            return asked
        usual, best = patient.select_default(scene), patient.select_best(scene)
        if usual == "fem":
            from ..play.deformers import TRUTH_TEXT

            none = (
                "no model exists next to this anatomy; `sulcus train` trains one"
                if scene.observation_model is None
                else TRUTH_TEXT
            )
            reason = next(iter(patient.list_rejections(scene).values()), none)
            print(f"{args.program}: FEM is used for {scene.name} instead of a trained model: {reason}", file=sys.stderr)
        if best in patient.models and usual != scene.deformer:
            from surrogate.model.guarded import describe_error, get_reported_errors

            model = patient.models[best]
            if get_reported_errors(model).is_weak:
                print(f"{args.program}: on held-out cortex, {best}: {describe_error(model)}", file=sys.stderr)
        return usual
    if args.deformer not in (None, "auto"):
        raise InputError(f"--deformer {args.deformer} leaves a budget nothing to choose: give one of them, or auto.")
    from ..analysis.budget import choose_within

    choice = choose_within(patient, scene, budget, lambda words: print(f"{args.program}: {words}", file=sys.stderr))
    print(f"{args.program}: {choice.reason}", file=sys.stderr)
    return choice.candidate.name
