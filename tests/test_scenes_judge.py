"""Model evaluation with the element and the tissue of the training."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_box
from programs import simulated
from theatres import small, theatre_of

from scenes.play.deformers import PatientSetup, open_theatre
from scenes.play.reference import solve_reference_frames
from scenes.script.craniotomy_frame import build_craniotomy_frame
from scenes.script.scene import Scene
from sim.accuracy import TRAIN
from sim.anatomy import Anatomy
from sim.bodies.meshfile import write_anatomy
from sim.effects import Elasticity
from sim.elements import RECOMMENDED
from sim.errors import InputError
from sim.fem import Fem
from sim.material import BRAIN, Material, Tissue
from surrogate.data.dataset import read_dataset
from surrogate.model.store import save

STIFF = Material("linear", 9000.0, 0.3)


@pytest.fixture(scope="module")
def body() -> Anatomy:
    return make_box(cells=(6, 6, 4), spacing=12e-3, tumour=14e-3)


def physics(theatre: PatientSetup, scene: Scene) -> tuple[str, Tissue | None]:
    """Element and default tissue of a theatre's finite elements."""
    fem = theatre.build_deformer("fem", scene)
    assert isinstance(fem, Fem)
    elasticity = next(effect for effect in fem.effects if isinstance(effect, Elasticity))
    return fem.space.element, elasticity.default


def test_models_are_evaluated_with_their_training_tissue(box, body, tmp_path) -> None:
    """Through the model file, for reference solutions of frames and for FEM of the page."""
    words = "--element", "smoothed", "--material", STIFF.law, "--young", "9000", "--poisson", "0.3"
    provenance = read_dataset(simulated(body, tmp_path, *words)).provenance
    models = theatre_of(box).models
    trained = {name: replace(model, training={"learner": name, **provenance}) for name, model in models.items()}
    write_anatomy(tmp_path / "box.vtu", box)
    save(tmp_path / "box.model.npz", trained)
    theatre = open_theatre(tmp_path / "box.vtu", device="cpu")
    assert physics(theatre, small()) == ("smoothed", BRAIN)
    assert theatre.list_deformers(small()) == ("fem",)
    scene = small().replace_tissue(STIFF, "smoothed")
    assert physics(theatre, scene) == ("smoothed", STIFF) and theatre.list_deformers(scene) == (
        *trained,
        "guarded",
        "fem",
    )
    loads = [scene.build_loads(build_craniotomy_frame(box), scene.path(1.0), 1.0)]
    others = tuple(effect for effect in scene.effects if not isinstance(effect, Elasticity))
    right = Fem(box, (Elasticity(STIFF), *others), TRAIN, "cpu", element="smoothed").deform(loads[0])
    found = solve_reference_frames(theatre, scene, loads)
    assert np.array_equal(found.displacement, right.displacement) and found.displacement.any()


def test_without_models_scene_gives_tissue_and_element(box) -> None:
    bare = replace(theatre_of(box), models={})
    assert physics(bare, small()) == (RECOMMENDED, BRAIN)
    assert physics(bare, replace(small(), element="p1")) == ("p1", BRAIN)


def test_model_with_unreadable_tissue_is_rejected(box) -> None:
    theatre = theatre_of(box)
    model = theatre.models["linear"]
    for text in ("jelly", "{}", "[]"):
        broken = replace(theatre, models={"linear": replace(model, training={"tissue": text})})
        with pytest.raises(InputError, match="is not a tissue supported by this version"):
            broken.build_deformer("linear", small())
