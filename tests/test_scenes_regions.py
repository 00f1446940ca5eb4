"""Regions of a stiffness of their own, by `--region`: from simulate and train to the scenes that play the models."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from test_sim_anatomy import hollowed, necrotic_labels

from scenes.cli import main
from scenes.report.finite_elements import change_law as tissue_of_law
from scenes.report.study import ReportStudy
from sim.accuracy import TRAIN
from sim.anatomy import NECROSIS_LABEL, TUMOUR_LABEL
from sim.bodies.meshfile import write_anatomy
from sim.effects import Elasticity, build_push_effects
from sim.fem import Fem
from sim.material import BRAIN, Material
from surrogate.data.dataset import read_dataset
from surrogate.data.solution_rows import read_tissue_statement
from surrogate.training.expansion import Expansion

STIFF, SOFT = replace(BRAIN, young=9000.0), replace(BRAIN, young=500.0)
TISSUE = Elasticity(BRAIN, {TUMOUR_LABEL: STIFF, NECROSIS_LABEL: SOFT})
WORDS = "--region", "necrosis:500", "--region", "tumour:9000"


@pytest.fixture(scope="module")
def data(small_box, tmp_path_factory):
    """Two loads of a body with a soft core, simulated by the command."""
    folder = tmp_path_factory.mktemp("regions")
    write_anatomy(folder / "body.vtu", hollowed(small_box))
    assert main(["simulate", str(folder / "body.vtu"), "--out", str(folder / "a.h5"), *RUN, *WORDS]) == 0
    return folder / "a.h5"


RUN = "--count", "2", "--device", "cpu", "--element", "p1", "--json"


class TestData:
    def test_are_of_the_regions_tissue_and_state_it(self, data):
        found = read_dataset(data)
        assert read_tissue_statement(found.provenance) == TISSUE
        truth = Fem(found.anatomy, build_push_effects(found.anatomy, TISSUE), TRAIN, "cpu", element="p1").deform(
            found.loads
        )
        stored = found.read_displacement(np.arange(len(found.anatomy.mesh.nodes)))
        assert np.linalg.norm(stored - truth.displacement) < 1e-3 * np.linalg.norm(truth.displacement)

    def test_are_reported_in_every_law_of_it(self, data):
        study = ReportStudy(data, data.parent)
        assert study.tissue == TISSUE
        linear = tissue_of_law(study.tissue, "linear")
        assert linear.get_law(NECROSIS_LABEL) == Material("linear", 500.0, BRAIN.poisson)
        whole = study.anatomy.remove_elements(np.flatnonzero(study.anatomy.mesh.mark_elements(NECROSIS_LABEL)))
        assert study.get_tissue_on(whole) == Elasticity(BRAIN, {TUMOUR_LABEL: STIFF})

    def test_are_trained_on_with_it(self, data):
        assert TISSUE in Expansion(read_dataset(data), "cpu").build_fem().effects

    def test_do_not_go_on_with_another(self, data, capsys):
        command = ["simulate", str(data.with_name("body.vtu")), "--out", str(data), *RUN]
        assert main([*command, "--region", "necrosis:600"]) == 2
        assert "was made with effects" in capsys.readouterr().err


class TestPatient:
    def test_hands_them_on(self, tmp_path, monkeypatch):
        steps: list[list[str]] = []
        monkeypatch.setattr("scenes.cli.main", lambda step: steps.append(step) or 0)
        labels = ["a.nii", "--brain", "1", "--tumour", "3", "--necrosis", "6", *WORDS, "--region", "oedema:2000"]
        assert main(["patient", *labels, "--out", str(tmp_path / "me.vtu"), "--device", "cpu"]) == 0
        assert "--necrosis=6" in steps[0] and "--regions=oedema,necrosis" in steps[0]
        assert steps[1][-3:] == ["--region=necrosis:500", "--region=tumour:9000", "--region=oedema:2000"]

    def test_shows_them_first(self, tmp_path, capsys):
        path = necrotic_labels(tmp_path)
        words = [
            "patient",
            str(path),
            "--brain",
            "1",
            "--tumour",
            "3",
            "--necrosis",
            "6",
            "--out",
            str(tmp_path / "a.vtu"),
        ]
        assert main([*words, "--inspect"]) == 0
        assert "ml: a region of its own, as stiff as the tumour\n" in capsys.readouterr().out
        assert main([*words, "--inspect", "--force", "--json", "--region", "necrosis:500"]) == 0
        made = {"tumour": "as stiff as the brain", "necrosis": "neo-hookean, E 0.5 kPa, nu 0.49"}
        assert json.loads(capsys.readouterr().out)["regions"] == made

    def test_shows_the_tumours_and_doubts_what_no_tissue_has(self, tmp_path, capsys):
        words = ["patient", str(necrotic_labels(tmp_path)), "--brain", "1", "--tumour", "3", "--necrosis", "6"]
        words += ["--out", str(tmp_path / "a.vtu"), "--inspect", "--region", "necrosis:500", "--region"]
        assert main([*words, "tumour:9000"]) == 0
        said = capsys.readouterr()
        assert "in 1 piece, neo-hookean, E 9 kPa, nu 0.49\n" in said.out and "Pa is" not in said.out + said.err
        with pytest.warns(UserWarning, match=r"--region tumour:9: a Young's modulus of 9 Pa is .* for 9 kPa give 9000"):
            assert main([*words, "tumour:9", "--force", "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["regions"]["tumour"] == "neo-hookean, E 0.009 kPa, nu 0.49"
        assert any(one.startswith("tumour: a Young's modulus of 9 Pa") for one in found["warnings"])

    def test_refuses_a_region_that_no_patient_has(self, tmp_path, capsys):
        words = "patient", "a.nii", "--brain", "1", "--tumour", "3", "--out", str(tmp_path / "a.vtu")
        assert main([*words, "--region", "7:300"]) == 2
        assert "a patient has no such region. Choose from tumour, oedema" in capsys.readouterr().err
