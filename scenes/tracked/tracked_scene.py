"""Scene of the brain under a tracked tool, and selection of its deformer."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from sim.errors import InputError

if TYPE_CHECKING:
    from sim.deformation import Deformer
    from sim.tools import BuiltIn

    from ..play.deformers import PatientSetup
    from ..script.scene import Scene

REST = "rest"
"""Name of the option value for which the brain stays undeformed, as in the scan."""


def build_tracked_scene(args: argparse.Namespace, tool_shape: BuiltIn | None) -> Scene:
    """Build the scene of the brain from command-line arguments: tissue, skull, and contact with a tool, if any."""
    from sim.effects import SKULLS, Elasticity, Held, ToolContact

    from ..script.scene import Scene
    from ..script.viewpoint import PLAIN_APPEARANCE

    touched = () if tool_shape is None else (ToolContact((tool_shape,)),)
    effects = (Elasticity(), Held(), SKULLS[args.skull], *touched)
    return Scene(args.command, "A tracked tool.", effects=effects, look=PLAIN_APPEARANCE)


def build_requested_deformer(
    args: argparse.Namespace, patient: PatientSetup, scene: Scene, has_tool: bool
) -> tuple[Deformer | None, str]:
    """Build the requested deformer of the brain under a tracked tool, and its description.

    Raises
    ------
    InputError
        The deformer does not exist, or does not support the scene.
    """
    from ..play.deformers import GUARDED

    still = "none: the brain stays as in the scan"
    if not has_tool:
        return None, still
    name = args.deformer
    if name is None and not patient.select_models(scene):
        refused = next(iter(patient.list_rejections(scene).values()), "there is none")
        said = f"no model says how the brain moves: {refused}. Give --deformer fem, or a model of the tool's poses"
        print(f"{args.program}: {said}", file=sys.stderr)
        name = REST
    if name == REST:
        return None, still
    name = name or patient.select_default(scene)
    names = (*patient.list_deformers(scene), REST)
    if name not in (*names, *patient.models, GUARDED):
        raise InputError(f"no deformer is called {name!r} here: choose one of {', '.join(names)}.")
    return patient.build_deformer(name, scene), patient.describe_deformer(name, scene)
