"""Scene of the brain under a tracked tool, and its deformer."""

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
"""Name of the deformer that leaves the brain undeformed, as in the scan."""


def build_tracked_scene(args: argparse.Namespace, shape: BuiltIn | None) -> Scene:
    """Build the scene of the brain: the tool, moved by pose, and the skull."""
    from sim.effects import SKULLS, Elasticity, Held, ToolContact

    from ..script.scene import Scene
    from ..script.viewpoint import PLAIN_APPEARANCE

    touched = () if shape is None else (ToolContact((shape,)),)
    effects = (Elasticity(), Held(), SKULLS[args.skull], *touched)
    return Scene(args.command, "A tracked tool.", effects=effects, look=PLAIN_APPEARANCE)


def build_mover(
    args: argparse.Namespace, theatre: PatientSetup, scene: Scene, tooled: bool
) -> tuple[Deformer | None, str]:
    """Select the deformer of the brain under a tracked tool, if there is one, with its description.

    Raises
    ------
    InputError
        A deformer that does not exist, or does not support the scene.
    """
    from ..play.deformers import GUARDED

    still = "none: the brain stays as in the scan"
    if not tooled:
        return None, still
    name = args.deformer
    if name is None and not theatre.select_models(scene):
        refused = next(iter(theatre.list_rejections(scene).values()), "there is none")
        said = f"no model says how the brain moves: {refused}. Give --deformer fem, or a model of the tool's poses"
        print(f"{args.program}: {said}", file=sys.stderr)
        name = REST
    if name == REST:
        return None, still
    name = name or theatre.select_default(scene)
    names = (*theatre.list_deformers(scene), REST)
    if name not in (*names, *theatre.models, GUARDED):
        raise InputError(f"no deformer is called {name!r} here: choose one of {', '.join(names)}.")
    return theatre.build_deformer(name, scene), theatre.describe_deformer(name, scene)
