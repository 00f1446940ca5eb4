"""What was trained with an element and a tissue is judged with them, from `sulcus simulate` to the truth of a scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from boxes import quadratic
from conftest import make_box
from theatres import small, theatre_of

from scenes.builtin.retract import RELAXING
from scenes.cli import main
from scenes.play.deformers import Theatre, open_theatre
from scenes.play.reference import truth_of
from scenes.script.scene import Scene
from scenes.script.site import site_of
from sim.accuracy import TRAIN
from sim.anatomy import Anatomy
from sim.bodies.meshfile import write_anatomy
from sim.effects import Elasticity, Held, Slide, ToolForce
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


def simulated(anatomy: Anatomy, folder: Path, *words: str) -> Path:
    write_anatomy(folder / "body.vtu", anatomy)
    command = ["simulate", str(folder / "body.vtu"), "--out", str(folder / "data.h5"), "--count", "2", "--json"]
    assert main([*command, "--device", "cpu", *words]) == 0
    return folder / "data.h5"


@pytest.mark.parametrize("element", ["p1", "p2", "smoothed"])
def test_simulate_answers_by_the_element_asked_for_and_says_so(body, tmp_path, capsys, element) -> None:
    data = read_dataset(simulated(body, tmp_path, "--element", element))
    assert data.provenance["element"] == element and data.good.all()
    effects = (Elasticity(), *(effect for effect in small().effects if not isinstance(effect, Elasticity)))
    truth = Fem(body, effects, TRAIN, "cpu", element=element).deform(data.loads).displacement
    stored = data.displacement(np.arange(len(body.mesh.nodes)))
    assert np.linalg.norm(stored - truth) < 1e-3 * np.linalg.norm(truth)
    # The same command goes on where it stopped; with another element it would mix two sets.
    other = "p1" if element != "p1" else "smoothed"
    again = ["simulate", str(tmp_path / "body.vtu"), "--out", str(tmp_path / "data.h5"), "--count", "2"]
    assert main([*again, "--device", "cpu", "--element", other]) == 2
    assert f"element {element}, but now element is {other}" in capsys.readouterr().err


def test_simulate_of_a_body_without_tumour_says_so(tmp_path, capsys) -> None:
    simulated(make_box(cells=(6, 6, 4), spacing=12e-3, tumour=0.0), tmp_path)
    assert "has no tumour: `sulcus train` will reject the data." in capsys.readouterr().err


def test_simulate_takes_quadratic_anatomies_as_they_are(body, tmp_path, capsys) -> None:
    mesh = quadratic(body.mesh)
    more = len(mesh.nodes) - len(body.mesh.nodes)
    wall = mesh.nodes[:, 2] < body.mesh.nodes[:, 2].min() + 1e-9
    held = np.repeat(wall[:, None], 3, axis=1)
    anatomy = Anatomy(mesh, held, np.zeros_like(mesh.nodes), np.append(body.craniotomy, np.zeros(more, bool)))
    data = read_dataset(simulated(anatomy, tmp_path))
    assert data.provenance["element"] == "p2" and data.anatomy.digest == anatomy.digest
    assert data.displacement(anatomy.tumour_nodes).shape == (2, len(anatomy.tumour_nodes), 3) and data.good.all()
    assert len(anatomy.tumour_nodes) > len(body.tumour_nodes)
    capsys.readouterr()
    assert main(["simulate", str(tmp_path / "body.vtu"), "--out", str(tmp_path / "no.h5"), "--element", "p1"]) == 2
    assert "take p2" in capsys.readouterr().err and not (tmp_path / "no.h5").exists()


@pytest.mark.parametrize(
    ("words", "expected"),
    [((), (BRAIN.law, None)), (("--element", "p2", "--material", "corotational"), ("corotational", "p2"))],
)
def test_a_patient_hands_tissue_and_element_on(tmp_path, monkeypatch, words, expected) -> None:
    steps: list[list[str]] = []
    monkeypatch.setattr("scenes.cli.main", lambda step: steps.append(step) or 0)
    labels = ["labels.nii.gz", "--brain", "1", "--tumour", "2"]
    assert main(["patient", *labels, "--out", str(tmp_path / "me.vtu"), "--device", "cpu", *words]) == 0
    assert [step[0] for step in steps] == ["anatomy", "simulate", "train"]
    element = [] if expected[1] is None else ["--element", expected[1]]
    assert steps[1][steps[1].index("--material") :] == ["--material", expected[0], *element]
    assert steps[2][-4:] == ["--learners", "linear,series,series-gp", "--device", "cpu"]


def physics(theatre: Theatre, scene: Scene) -> tuple[str, Tissue | None]:
    """Element and default tissue of a theatre's finite elements."""
    fem = theatre.deformer("fem", scene)
    assert isinstance(fem, Fem)
    elasticity = next(effect for effect in fem.effects if isinstance(effect, Elasticity))
    return fem.space.element, elasticity.default


def test_models_are_judged_with_what_they_were_trained_on(box, body, tmp_path) -> None:
    """Through the model file, and for the truth of frames as for the page's finite elements."""
    words = "--element", "smoothed", "--material", STIFF.law, "--young", "9000", "--poisson", "0.3"
    provenance = read_dataset(simulated(body, tmp_path, *words)).provenance
    models = theatre_of(box).models
    trained = {name: replace(model, training={"learner": name, **provenance}) for name, model in models.items()}
    write_anatomy(tmp_path / "box.vtu", box)
    save(tmp_path / "box.model.npz", trained)
    theatre = open_theatre(tmp_path / "box.vtu", device="cpu")
    assert physics(theatre, small()) == ("smoothed", BRAIN)
    assert theatre.names(small()) == ("fem",)
    scene = small().made_of(STIFF, "smoothed")
    assert physics(theatre, scene) == ("smoothed", STIFF) and theatre.names(scene) == (*trained, "guarded", "fem")
    loads = [scene.loads(site_of(box), scene.path(1.0), 1.0)]
    others = tuple(effect for effect in scene.effects if not isinstance(effect, Elasticity))
    right = Fem(box, (Elasticity(STIFF), *others), TRAIN, "cpu", element="smoothed").deform(loads[0])
    found = truth_of(theatre, scene, loads)
    assert np.array_equal(found.displacement, right.displacement) and found.displacement.any()


def test_the_truth_of_a_frame_knows_what_went_before() -> None:
    """Tissue that relaxes: pressed, held and all but let go, it is not where it was never pressed."""
    anatomy = make_box(cells=(6, 6, 4), spacing=9e-3, tumour=12e-3, depth=20e-3, opening=22e-3)
    theatre = Theatre(anatomy, None, {}, "cpu")
    scene = replace(small(), effects=(Elasticity(RELAXING), Held(), Slide(), ToolForce()), element="p1")
    moments = ((1.5, 0.5), (1.5, 2.0), (0.5, 2.2))
    loads = [scene.loads(theatre.site, scene.path(moment), time) for moment, time in moments]
    found, fem, last = truth_of(theatre, scene, loads).displacement, theatre.fem(scene, TRAIN), None
    for row, load in zip(found, loads, strict=True):
        last = fem.deform(load, start=last)
        np.testing.assert_allclose(row, last.displacement[0], atol=1e-9)
    alone = fem.deform(loads[2]).displacement[0]
    assert np.linalg.norm(found[2] - alone) > 0.1 * np.linalg.norm(alone)


def test_the_scene_names_tissue_and_element(box) -> None:
    bare = replace(theatre_of(box), models={})
    assert physics(bare, small()) == (RECOMMENDED, BRAIN)
    assert physics(bare, replace(small(), element="p1")) == ("p1", BRAIN)


def test_a_tissue_that_cannot_be_read_is_a_sentence(box) -> None:
    theatre = theatre_of(box)
    model = theatre.models["linear"]
    for text in ("jelly", "{}", "[]"):
        broken = replace(theatre, models={"linear": replace(model, training={"tissue": text})})
        with pytest.raises(InputError, match="is no tissue that this version knows"):
            broken.deformer("linear", small())
