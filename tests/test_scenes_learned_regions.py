"""Regions with their own tissue: option `--region` of each command, and regions of trained models."""

import argparse
import json
from dataclasses import replace

import numpy as np
import pytest
from test_sim_anatomy import hollowed, necrotic_labels
from test_sim_conformance import YEOH
from theatres import short, small

from scenes.analysis.uncertainty import apply_sample, get_tissue
from scenes.builtin.retract import RELAXING_BRAIN
from scenes.cli import main
from scenes.options.tissue_options import add_element_argument, add_tissue_arguments, apply_tissue_options
from scenes.play.deformers import open_theatre
from scenes.report.finite_elements import change_law as tissue_of_law
from scenes.report.study import ReportStudy
from scenes.script.priors import PatientSample
from scenes.script.scene import find_scene
from sim.accuracy import TRAIN
from sim.anatomy import NECROSIS_LABEL, TUMOUR_LABEL
from sim.bodies.meshfile import write_anatomy
from sim.effects import Elasticity, build_push_effects
from sim.errors import InputError
from sim.fem import Fem
from sim.material import BRAIN, Material, Ogden
from sim.named_tissues import MATERIALS
from surrogate.data.dataset import read_dataset
from surrogate.data.solution_rows import describe_tissue_source, read_tissue_text
from surrogate.training.expansion import Expansion

STIFF, SOFT = BRAIN.replace_constants(9000.0), BRAIN.replace_constants(500.0)
TISSUE = Elasticity(BRAIN, {TUMOUR_LABEL: STIFF, NECROSIS_LABEL: SOFT})
WORDS = "--region", "necrosis:500", "--region", "tumour:9000"


@pytest.fixture(scope="module")
def theatre():
    """The template with a soft core, and a model that states that it learned from it."""
    whole = open_theatre(device="cpu")
    body, model = hollowed(whole.anatomy), whole.models["series-gp"]
    learned = replace(model, anatomy=body, training={**model.training, **describe_tissue_source(TISSUE)})
    return replace(whole, anatomy=body, models={"series-gp": learned})


def asked(theatre, scene, *words):
    """The scene as a command makes it."""
    parser = argparse.ArgumentParser()
    add_tissue_arguments(parser)
    add_element_argument(parser)
    return apply_tissue_options(parser.parse_args(words), scene, theatre)


class TestScenes:
    def test_scenes_have_the_regions_of_the_models(self, theatre):
        scene = asked(theatre, short())
        assert scene.elasticity == TISSUE and theatre.list_rejections(scene) == {"series-gp": None}

    def test_scenes_keep_region_tissue_and_reject_other_model(self, theatre, capsys):
        scene = asked(theatre, short(), "--region", "5:400")
        assert scene.elasticity == Elasticity(
            BRAIN, {TUMOUR_LABEL: STIFF, NECROSIS_LABEL: BRAIN.replace_constants(400.0)}
        )
        kept = "press keeps the tissue from the models' training data: region 2 (tumour): neo-hookean, E 9 kPa, nu 0.49"
        assert capsys.readouterr().err == f"{kept}\n"
        asked(theatre, short(), *WORDS)
        assert capsys.readouterr().err == ""
        with pytest.raises(InputError, match=r"E 0\.5 kPa.*, and here it is .*\(necrosis\): neo-hookean, E 0\.4 kPa"):
            theatre.build_deformer("series-gp", scene)
        assert theatre.list_rejections(short())["series-gp"] is not None  # as the scene has it, without a command

    def test_scenes_scale_region_stiffness_with_the_brain(self, theatre):
        for scene in (asked(theatre, short(), "--young", "2100", "--poisson", "0.45"), find_scene("brain_shift")):
            found = asked(theatre, scene).elasticity
            assert found.default == Material(BRAIN.law, 2100.0, 0.45)
            assert found.get_law(NECROSIS_LABEL) == Material(BRAIN.law, 350.0, 0.45)
        minutes = asked(theatre, short(), "--material", "minutes").elasticity
        necrosis = minutes.get_law(NECROSIS_LABEL)
        assert isinstance(necrosis, Ogden) and necrosis.young == pytest.approx(MATERIALS["minutes"].tissue.young / 6.0)

    def test_scenes_with_relaxing_brain_relax_in_all_regions(self, theatre):
        found = asked(theatre, find_scene("retract")).elasticity
        assert found.default == RELAXING_BRAIN
        assert found.get_law(NECROSIS_LABEL) == replace(SOFT, prony=RELAXING_BRAIN.prony)

    def test_scenes_keep_their_own_region_tissue(self, theatre):
        own = find_scene("sag").elasticity
        found = asked(theatre, find_scene("sag")).elasticity
        assert found.get_law(TUMOUR_LABEL) == own.get_law(TUMOUR_LABEL) != STIFF and found.get_law(
            NECROSIS_LABEL
        ) != own.get_law(5)

    def test_scenes_reject_region_absent_from_the_mesh(self, theatre):
        for word in ("oedema:2000", "3:2000", "-1:5"):
            with pytest.raises(InputError, match=r"the mesh has no region .* It has region 1 \(brain\), region 2"):
                asked(theatre, short(), f"--region={word}")

    def test_samples_scale_region_stiffness_with_the_brain(self):
        scene = small().replace_regions({NECROSIS_LABEL: SOFT})
        assert get_tissue(scene) == BRAIN
        draw = PatientSample(stiffness=2.0, poisson=0.45, ratio=3.0, skull=0.5, tip=(0.0, 0.0, 0.0), mesh=0.0)
        found = apply_sample(scene, draw).elasticity
        assert found.get_law(TUMOUR_LABEL) == BRAIN.replace_constants(6.0 * BRAIN.young, 0.45)
        assert found.get_law(NECROSIS_LABEL) == BRAIN.replace_constants(1000.0, 0.45)
        stated = apply_sample(
            scene.replace_regions({TUMOUR_LABEL: STIFF}), draw
        ).elasticity  # three times as stiff, as such
        assert stated.get_law(TUMOUR_LABEL) == BRAIN.replace_constants(18.0 * BRAIN.young, 0.45)
        assert stated.get_law(NECROSIS_LABEL) == found.get_law(NECROSIS_LABEL) and stated.default == found.default
        with pytest.raises(InputError, match=r"the scene .* has another tissue: Yeoh"):
            get_tissue(small().replace_regions({TUMOUR_LABEL: YEOH.Yeoh(500.0, 0.0, 1e4)}))


@pytest.fixture(scope="module")
def data(small_box, tmp_path_factory):
    """Two loads of a body with a soft core, simulated by the command."""
    folder = tmp_path_factory.mktemp("regions")
    write_anatomy(folder / "body.vtu", hollowed(small_box))
    assert main(["simulate", str(folder / "body.vtu"), "--out", str(folder / "a.h5"), *RUN, *WORDS]) == 0
    return folder / "a.h5"


RUN = "--count", "2", "--device", "cpu", "--element", "p1", "--json"


class TestData:
    def test_data_set_is_solved_with_and_states_region_tissue(self, data):
        found = read_dataset(data)
        assert read_tissue_text(found.provenance) == TISSUE
        truth = Fem(found.anatomy, build_push_effects(found.anatomy, TISSUE), TRAIN, "cpu", element="p1").deform(
            found.loads
        )
        stored = found.read_displacement(np.arange(len(found.anatomy.mesh.nodes)))
        assert np.linalg.norm(stored - truth.displacement) < 1e-3 * np.linalg.norm(truth.displacement)

    def test_report_converts_region_tissue_to_each_law(self, data):
        study = ReportStudy(data, data.parent)
        assert study.tissue == TISSUE
        linear = tissue_of_law(study.tissue, "linear")
        assert linear.get_law(NECROSIS_LABEL) == Material("linear", 500.0, BRAIN.poisson)
        whole = study.anatomy.remove_elements(np.flatnonzero(study.anatomy.mesh.mark_elements(NECROSIS_LABEL)))
        assert study.get_tissue_on(whole) == Elasticity(BRAIN, {TUMOUR_LABEL: STIFF})

    def test_expansion_is_trained_with_region_tissue(self, data):
        assert TISSUE in Expansion(read_dataset(data), "cpu").build_fem().effects

    def test_simulate_rejects_resuming_with_other_region_tissue(self, data, capsys):
        command = ["simulate", str(data.with_name("body.vtu")), "--out", str(data), *RUN]
        assert main([*command, "--region", "necrosis:600"]) == 2
        assert "was made with effects" in capsys.readouterr().err


class TestPatient:
    def test_patient_command_passes_regions_to_each_step(self, tmp_path, monkeypatch):
        steps: list[list[str]] = []
        monkeypatch.setattr("scenes.cli.main", lambda step: steps.append(step) or 0)
        labels = ["a.nii", "--brain", "1", "--tumour", "3", "--necrosis", "6", *WORDS, "--region", "oedema:2000"]
        assert main(["patient", *labels, "--out", str(tmp_path / "me.vtu"), "--device", "cpu"]) == 0
        assert "--necrosis=6" in steps[0] and "--regions=oedema,necrosis" in steps[0]
        assert steps[1][-3:] == ["--region=necrosis:500", "--region=tumour:9000", "--region=oedema:2000"]

    def test_patient_inspection_shows_region_tissue(self, tmp_path, capsys):
        path = necrotic_labels(tmp_path)
        words = f"patient {path} --brain 1 --tumour 3 --necrosis 6 --out {tmp_path / 'a.vtu'}".split()
        assert main([*words, "--inspect"]) == 0
        assert "ml: a region of its own, as stiff as the tumour\n" in capsys.readouterr().out
        assert main([*words, "--inspect", "--force", "--json", "--region", "necrosis:500"]) == 0
        made = {"tumour": "as stiff as the brain", "necrosis": "neo-hookean, E 0.5 kPa, nu 0.49"}
        assert json.loads(capsys.readouterr().out)["regions"] == made

    def test_patient_inspection_warns_of_implausible_stiffness(self, tmp_path, capsys):
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

    def test_patient_command_rejects_unknown_region(self, tmp_path, capsys):
        words = "patient", "a.nii", "--brain", "1", "--tumour", "3", "--out", str(tmp_path / "a.vtu")
        assert main([*words, "--region", "7:300"]) == 2
        assert "a patient has no such region. Choose from tumour, oedema" in capsys.readouterr().err
