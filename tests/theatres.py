"""A small theatre: the shared box, models trained on finite elements in a second, and short scenes to play in it."""

import os
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ar.optics.calibration import Calibration
from ar.optics.lens import Lens
from scenes.play.deformers import PatientSetup, to_model_path
from scenes.play.player import Player
from scenes.play.stage import Stage
from scenes.script.head_pose import build_drained_turn
from scenes.script.scene import SCENES, Scene, Viewpoint, find_scene
from scenes.script.shipped_files import get_template_path
from scenes.script.tool_paths import keep_idle, press
from sim.accuracy import LIVE, TRAIN
from sim.anatomy import Anatomy
from sim.bodies.intensity import Intensity, read_intensity, to_intensity_path, write_intensity
from sim.bodies.meshfile import read_anatomy, write_anatomy
from sim.bodies.subject import MeshPlan, make_anatomy
from sim.bodies.template import Tumour, build_template_subject
from sim.effects import Elasticity, Gravity, Held, NodalForce, Slide, ToolForce
from sim.fem import Fem
from sim.loads import Pushed
from surrogate.data.cortex_patch import open_patch
from surrogate.data.dataset import read_dataset
from surrogate.data.encode import Basis
from surrogate.data.simulate import simulate
from surrogate.data.tool_loads import draw
from surrogate.model.learned import Learned, ModelPart
from surrogate.model.store import load, save
from surrogate.model.training_range import compute_training_range
from surrogate.regressors.protocol import Linear
from surrogate.training.train import train

LENS = Lens(-4.0, 6.0, 0.02, -0.015, 0.0)
REAL = Calibration((1750.0, 1740.0), (250.0, 170.0), 480, 360, LENS, "theatre")
"""The calibrated camera that looks at a theatre."""
SIGHTED = tuple(name for name in SCENES if find_scene(name).observation_model is not None)
"""The built-in scenes in which a tumour is located."""
PUSHING = tuple(name for name in SCENES if ToolForce() in find_scene(name).effects and name not in SIGHTED)
"""The others in which a tool pushes."""


def knowing_nothing(anatomy: Anatomy, training: dict[str, str]) -> Learned:
    """A model that answers rest, and knows but its bound and what it states of its training."""
    patch, nodes = open_patch(anatomy), anatomy.tumour_nodes
    width = 3 * len(patch.nodes)
    part = ModelPart(
        "nodal", Linear().fit(np.eye(width), np.zeros((width, 1))), Basis(nodes, np.zeros((1, 3 * len(nodes))))
    )
    pushed = draw("palpation", anatomy, 2, 0).get(Pushed)
    return Learned(anatomy, (part,), compute_training_range(patch, pushed), 1.23e-4, training=training)


def trained_on(anatomy: Anatomy) -> dict[str, Learned]:
    """Both models, trained on a hundred loads."""
    fem = Fem(anatomy, (Elasticity(), Held(), Slide(), ToolForce(), NodalForce()), TRAIN, "cpu")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "data.h5"
        simulate(path, fem, draw("palpation", anatomy, 100, 0), {"preset": "palpation"})
        learnt = train(read_dataset(path), ["linear", "svr"]).models
    return {name: replace(model, anatomy=anatomy) for name, model in learnt.items()}


@cache
def theatre_of(anatomy: Anatomy) -> PatientSetup:
    """Models `linear` and `svr`, and a scan of slanted stripes."""
    shared = os.environ.get("SULCUS_TESTS_SHARED")
    kept = Path(shared or "", f"{anatomy.digest}.npz")
    if shared and kept.is_file():  # another process of this run has trained them
        models = dict(load(kept, anatomy))
    else:
        models = trained_on(anatomy)
        if shared:
            save(kept, models)
    stripes = 127.5 + 127.5 * np.sin(np.indices((40, 40, 24)).sum(axis=0) / 3.0)
    affine = np.diag([2e-3, 2e-3, 2e-3, 1.0])
    affine[:3, 3] = anatomy.mesh.nodes.mean(axis=0) - [0.04, 0.04, 0.02]
    return PatientSetup(anatomy, Intensity(stripes.astype(np.uint8), affine), models, "cpu")


@cache
def coarse_brain() -> Anatomy:
    """The brain that ships, on 2,000 nodes: meshed once a run."""
    shared = os.environ.get("SULCUS_TESTS_SHARED")
    kept = Path(shared or "", "coarse.vtu")
    if shared and kept.is_file():
        return read_anatomy(kept)
    made = make_anatomy(build_template_subject(Tumour()), MeshPlan(2000))
    if shared:
        write_anatomy(kept, made)
    return made


@cache
def template_theatre() -> PatientSetup:
    """The anatomy that ships, and finite elements that every scene on it shares."""
    path = get_template_path()
    return PatientSetup(read_anatomy(path), read_intensity(to_intensity_path(path)), {}, "cpu")


@cache
def template_fem() -> Fem:
    return Fem(template_theatre().anatomy, find_scene("press").effects, LIVE, "cpu")


def on_template(name: str) -> Player:
    """A built-in scene by finite elements, on fewer pixels."""
    theatre = template_theatre()
    return Player(Stage(small(name), theatre.site, theatre.intensity), template_fem())


def put(theatre: PatientSetup, path: Path) -> Path:
    """The theatre as files: anatomy, scan and models beside it."""
    write_anatomy(path, theatre.anatomy)
    assert theatre.intensity is not None
    write_intensity(to_intensity_path(path), theatre.intensity)
    save(to_model_path(path), theatre.models)
    return path


def small(name: str = "press", **values: object) -> Scene:
    """A built-in scene on fewer pixels."""
    return replace(find_scene(name), viewpoint=Viewpoint(width=320, height=240), **values)


def short() -> Scene:
    """Seven small frames: press and let go."""
    return small(path=press(0.25, rise=0.1, hold=0.0), duration=0.2)


def sinking() -> Scene:
    """Seven small frames without a tool: the fluid drains, and the head turns on its side."""
    lying = build_drained_turn(0.1, 0.0, 0.1, np.radians(60.0))
    effects = (Elasticity(), Held(), Slide(), Gravity())
    return replace(small(path=keep_idle, duration=0.2, effects=effects, tool=None, lying=lying), name="sinking")


def player(theatre: PatientSetup, scene: Scene, deformer: str) -> Player:
    """As the commands make it."""
    return theatre.build_player(deformer, scene)


class Silent:
    """A referee that has nothing to say, and no finite elements to prepare."""

    truth, failure, plan = None, None, ()

    def __init__(self, theatre, scene, turn):
        pass

    def ask(self, number, touch, rest=0.0):
        pass

    def close(self):
        pass
