"""What a process that plays one scene holds: a program that reads lines of a scene, more effects, a law, an element.

Each line is a JSON list, played by a fork that has imported what every scene needs, and that nothing was played in.
Prints as a line of JSON, or null where the play failed, the modules of `sim.terms` that were imported; where the
kernels come from that were compiled, and that were launched in a later frame; the classes of the terms that live; and
modules that no scene needs on this machine.
"""

import gc
import json
import os
import sys
from dataclasses import replace

import numpy as np
import warp as wp
from conftest import make_box

from scenes.play.deformers import PatientSetup
from scenes.play.player import Player
from scenes.play.stage import Stage
from scenes.script.scene import Scene, find_scene
from scenes.script.tool_paths import Touch
from sim import effects as known
from sim.anatomy import Anatomy
from sim.deformation import Outcome
from sim.effects import Elasticity
from sim.material import Material, Ogden
from sim.tools import Ball, Spatula

LAUNCHED: set[str] = set()
PACKAGES = ("sim.terms.contact", "sim.terms.laws")
TISSUES = {"ogden": Ogden(((1340.0, -2.0),), 3e4), "prony": Material("neo-hookean", 3000.0, 0.45, ((0.4, 0.5),))}
MADE = {"ToolContact": known.ToolContact((Ball(7e-3),)), "Retraction": known.Retraction(Spatula(12e-3, 20e-3, 1e-3))}
HEAVY = ("torch", "sim.linalg.dense_inverse", "pyamg", "sim.linalg.amg", "viser", "sklearn", "onnx")


def name_of(kernel: wp.Kernel) -> str:
    """The module whose source a kernel is, and its name."""
    return f"{kernel.func.__module__}:{kernel.func.__name__}"


def note_launches(launch):
    """`wp.launch` that notes what it launches."""

    def noting(kernel, *words, **more):
        LAUNCHED.add(name_of(kernel))
        return launch(kernel, *words, **more)

    return noting


def build_scene(name: str, more: str, law: str, element: str) -> Scene:
    """A built-in scene with more effects, another law for all tissue, another element."""
    scene = find_scene(name)
    effects = tuple(MADE[kind] if kind in MADE else getattr(known, kind)() for kind in more.split("+") if kind)
    if law:
        tissue = TISSUES[law] if law in TISSUES else Material(law, 3000.0, 0.45)
        scene = replace(scene, effects=(Elasticity(tissue), *scene.effects[1:]))
    return replace(scene, effects=(*scene.effects, *effects), element=element or scene.element)


def slippery(anatomy: Anatomy) -> Anatomy:
    """The same, its lower side a skull that it slides on."""
    height = anatomy.mesh.nodes[:, 2]
    low = height < height.min() + 1e-9
    return replace(anatomy, fixed=anatomy.fixed & ~low[:, None], slide_normal=np.outer(low, [0.0, 0.0, -1.0]))


def played(scene: Scene) -> dict[str, list[str]]:
    """Three frames of the scene's middle on a tiny box; the last is watched."""
    box = make_box((4, 4, 4), spacing=18e-3, tumour=16e-3, depth=30e-3, opening=26e-3)
    theatre = PatientSetup(slippery(box), None, {}, "cpu")
    player = Player(Stage(scene, theatre.site), theatre.build_deformer("fem", scene))
    last = None
    for number in range(3):
        LAUNCHED.clear()
        time = 0.35 * scene.duration + 0.4 * number
        loads = scene.build_loads(theatre.site, scene.path(time) if scene.tool else Touch(), time)
        last = player.deformer.deform(loads, start=last)
        # So coarse a body is folded and overstrained by a deep blade.
        assert last.outcome[0].good or last.outcome[0] in (Outcome.INVERTED, Outcome.OVERSTRAINED), last.outcome
    things = gc.get_objects()
    compiled = [thing for thing in things if isinstance(thing, wp.Kernel) and thing.module.execs]
    living = {type(thing).__name__ for thing in things if str(type(thing).__module__).startswith("sim.terms.")}
    modules = [name for name in sys.modules if name.startswith("sim.terms.") and name not in PACKAGES]
    return {
        "imported": sorted(name.removeprefix("sim.terms.") for name in modules),
        "compiled": sorted({name_of(kernel) for kernel in compiled}),
        "launched": sorted(LAUNCHED),
        "living": sorted(living),
        "heavy": sorted(set(HEAVY) & set(sys.modules)),
    }


if __name__ == "__main__":
    wp.launch = note_launches(wp.launch)
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            print(json.dumps(played(build_scene(*json.loads(line)))), flush=True)
            os._exit(0)
        if os.waitpid(child, 0)[1]:
            print("null", flush=True)
