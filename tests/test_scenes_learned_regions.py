"""Regions of a scene whose tissue the models beside its anatomy learned."""

from __future__ import annotations

import argparse
from dataclasses import replace

import pytest
from test_sim_anatomy import hollowed
from theatres import short, small

from scenes.analysis.uncertainty import apply_sample, get_tissue
from scenes.builtin.retract import RELAXING_BRAIN
from scenes.options.tissue_options import add_element_argument, add_tissue_arguments, apply_tissue_options
from scenes.play.deformers import open_theatre
from scenes.script.priors import PatientSample
from scenes.script.scene import find_scene
from sim.anatomy import NECROSIS_LABEL, TUMOUR_LABEL
from sim.effects import Elasticity
from sim.errors import InputError
from sim.material import BRAIN, MATERIALS, Material
from surrogate.data.solution_rows import describe_tissue_source

STIFF, SOFT = replace(BRAIN, young=9000.0), replace(BRAIN, young=500.0)


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
    def test_have_what_the_models_learned(self, theatre):
        scene = asked(theatre, short())
        assert scene.elasticity == TISSUE and theatre.list_rejections(scene) == {"series-gp": None}

    def test_other_scenes_keep_settings_and_reject_model(self, theatre, capsys):
        scene = asked(theatre, short(), "--region", "5:400")
        assert scene.elasticity == Elasticity(BRAIN, {TUMOUR_LABEL: STIFF, NECROSIS_LABEL: replace(BRAIN, young=400.0)})
        kept = "press keeps the tissue from the models' training data: region 2 (tumour): neo-hookean, E 9 kPa, nu 0.49"
        assert capsys.readouterr().err == f"{kept}\n"
        asked(theatre, short(), *WORDS)
        assert capsys.readouterr().err == ""
        with pytest.raises(InputError, match=r"E 0\.5 kPa.*, and here it is .*\(necrosis\): neo-hookean, E 0\.4 kPa"):
            theatre.build_deformer("series-gp", scene)
        assert theatre.list_rejections(short())["series-gp"] is not None  # as the scene has it, without a command

    def test_of_another_brain_have_it_as_many_times_as_stiff(self, theatre):
        for scene in (asked(theatre, short(), "--young", "2100", "--poisson", "0.45"), find_scene("brain_shift")):
            found = asked(theatre, scene).elasticity
            assert found.default == Material(BRAIN.law, 2100.0, 0.45)
            assert found.get_law(NECROSIS_LABEL) == Material(BRAIN.law, 350.0, 0.45)
        minutes = asked(theatre, short(), "--material", "minutes").elasticity
        assert minutes.get_law(NECROSIS_LABEL) == minutes.default  # Ogden's constants are no Young's modulus

    def test_that_relax_do_so_in_every_region(self, theatre):
        found = asked(theatre, find_scene("retract")).elasticity
        assert found.default == RELAXING_BRAIN
        assert found.get_law(NECROSIS_LABEL) == replace(SOFT, prony=RELAXING_BRAIN.prony)

    def test_keep_what_they_say_themselves(self, theatre):
        own = find_scene("sag").elasticity
        found = asked(theatre, find_scene("sag")).elasticity
        assert found.get_law(TUMOUR_LABEL) == own.get_law(TUMOUR_LABEL) != STIFF and found.get_law(
            NECROSIS_LABEL
        ) != own.get_law(5)

    def test_of_a_region_that_is_not_there_are_refused(self, theatre):
        for word in ("oedema:2000", "3:2000", "-1:5"):
            with pytest.raises(InputError, match=r"the mesh has no region .* It has region 1 \(brain\), region 2"):
                asked(theatre, short(), f"--region={word}")

    def test_draw_bodies_that_are_as_many_times_as_stiff(self):
        scene = small().replace_regions({NECROSIS_LABEL: SOFT})
        assert get_tissue(scene) == BRAIN
        draw = PatientSample(stiffness=2.0, poisson=0.45, ratio=3.0, skull=0.5, tip=(0.0, 0.0, 0.0), mesh=0.0)
        found = apply_sample(scene, draw).elasticity
        assert found.get_law(TUMOUR_LABEL) == replace(BRAIN, young=6.0 * BRAIN.young, poisson=0.45)
        assert found.get_law(NECROSIS_LABEL) == replace(BRAIN, young=1000.0, poisson=0.45)
        stated = apply_sample(
            scene.replace_regions({TUMOUR_LABEL: STIFF}), draw
        ).elasticity  # three times as stiff, as such
        assert stated.get_law(TUMOUR_LABEL) == replace(BRAIN, young=18.0 * BRAIN.young, poisson=0.45)
        assert stated.get_law(NECROSIS_LABEL) == found.get_law(NECROSIS_LABEL) and stated.default == found.default
        with pytest.raises(InputError, match=r"the scene .* has another tissue: ogden"):
            get_tissue(small().replace_regions({TUMOUR_LABEL: MATERIALS["minutes"].tissue}))
