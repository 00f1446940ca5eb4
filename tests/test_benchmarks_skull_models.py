"""Influence of the skull model, as measured by its benchmark."""

import json
from dataclasses import asdict

import numpy as np
import pytest
from programs import main
from theatres import coarse_brain

from benchmarks.studies.skull_models import measure_skulls
from sim.accuracy import TRAIN
from sim.anatomy import TUMOUR_LABEL
from sim.bodies.meshfile import write_anatomy
from sim.bodies.subject import MeshPlan, make_anatomy
from sim.bodies.template import Tumour, build_template_subject
from sim.debonding import Debonding
from sim.deformation import Outcome
from sim.effects import Bonded, Slide, build_push_effects
from sim.fem import Fem
from sim.material import Material
from surrogate.data.dataset import read_dataset
from surrogate.data.tool_loads import draw
from surrogate.model.applicability import read_trained_skull
from surrogate.training.expansion import Expansion


@pytest.fixture(scope="module")
def brain(tmp_path_factory):
    """A file and its anatomy."""
    path, anatomy = tmp_path_factory.mktemp("skulls") / "brain.vtu", coarse_brain()
    write_anatomy(path, anatomy)
    return str(path), anatomy


def test_skull_bench_matches_independent_finite_elements(brain, capsys):
    """Compared with finite elements and a volume mean over the tumour, computed in this test."""
    path, anatomy = brain
    words = [path, "--loads", "2", "--poisson", "0.49", "--device", "cpu", "--json"]
    assert main(["benchmarks", "skull", *words]) == 0
    bonded, slide = json.loads(capsys.readouterr().out)["rows"]
    assert (bonded["skull"], slide["skull"], bonded["failed"]) == ("bonded", "slide", 0)
    assert abs(slide["motion"] / bonded["motion"] - 1.0) > 0.02
    assert bonded["leaked"] == 0.0 and 0.01 < slide["leaked"] < 0.5
    assert 0.0 < bonded["bond"] < 3.0 and slide["bond"] is None
    tissue = Material("neo-hookean", 3000.0, 0.49)
    answer = Fem(anatomy, build_push_effects(anatomy, tissue), TRAIN, "cpu").deform(draw("palpation", anatomy, 2, 0))
    mesh = anatomy.mesh
    inside = mesh.region == TUMOUR_LABEL
    share = mesh.volumes[inside] / mesh.volumes[inside].sum()
    moved = np.einsum("t,bti->bi", share, answer.displacement[:, mesh.tets[inside]].mean(axis=2))
    assert bonded["motion"] == pytest.approx(1e3 * np.linalg.norm(moved, axis=1).mean(), rel=1e-4)
    assert bonded["bond"] == pytest.approx(answer.bond.max(), rel=1e-3)


def test_pressing_skull_allows_more_motion_than_bonded(brain, capsys):
    words = [brain[0], "--loads", "1", "--poisson", "0.45", "--device", "cpu", "--json"]
    assert main(["benchmarks", "skull", *words, "--skulls", "bonded", "tearing", "pressing"]) == 0
    bonded, tearing, pressing = json.loads(capsys.readouterr().out)["rows"]
    assert bonded["bond"] < 1.0 and tearing["motion"] == pytest.approx(bonded["motion"], rel=1e-6)
    assert pressing["motion"] > 1.1 * bonded["motion"] and pressing["leaked"] is None and pressing["bond"] == 0.0


def test_unconverged_tearing_is_excluded_from_the_mean(brain, capsys, monkeypatch):
    path, anatomy = brain
    (row,) = measure_skulls(
        [anatomy], ["pressing"], [0.45], draw("palpation", anatomy, 1, 0), "cpu", Debonding(max_solves=1)
    )
    assert row.failed == 1 and row.bond is None
    monkeypatch.setattr("benchmarks.studies.skull_models.measure_skulls", lambda *words: iter([row]))
    assert main(["benchmarks", "skull", path, "--loads", "1", "--device", "cpu", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["rows"] == [asdict(row) | {"motion": pytest.approx(np.nan, nan_ok=True)}]


def test_skull_rows_count_strained_loads(brain):
    _, anatomy = brain
    loads = draw("palpation", anatomy, 3, 0).select(slice(2, 3)).scale(np.full(1, 4.0))
    tissue = Material("neo-hookean", 3000.0, 0.45)
    limited = Fem(anatomy, build_push_effects(anatomy, tissue), TRAIN, "cpu").deform(loads)
    assert limited.outcome[0] in (Outcome.OVERSTRAINED, Outcome.INVERTED)
    (row,) = measure_skulls([anatomy], ["bonded"], [0.45], loads, "cpu")
    assert row.failed == 0 and row.bond == pytest.approx(limited.bond[0], rel=1e-3)


@pytest.mark.parametrize(
    ("words", "reason"), [(["--loads", "0"], "--loads is 0: give a whole"), (["--device", "tpu"], "no device")]
)
def test_skull_bench_rejects_invalid_input(brain, capsys, words, reason):
    assert main(["benchmarks", "skull", brain[0], *words]) == 2
    assert reason in capsys.readouterr().err


def test_learner_fem_uses_the_skull_model_of_the_data(tmp_path):
    """Simulated data with a sliding or bonded skull: the learner's finite elements use the same model."""
    write_anatomy(
        tmp_path / "brain.vtu", make_anatomy(build_template_subject(Tumour()), MeshPlan(2000, craniotomy=0.03))
    )
    for skull, effect in (("slide", Slide()), ("bonded", Bonded())):
        out = tmp_path / f"{skull}.h5"
        words = ["--count", "2", "--skull", skull, "--element", "p1", "--tolerance", "1e-3", "--device", "cpu"]
        assert main(["simulate", str(tmp_path / "brain.vtu"), "--out", str(out), *words]) == 0
        data = read_dataset(out)
        assert read_trained_skull(data.provenance) == skull
        assert effect in Expansion(data, "cpu").build_fem().effects
