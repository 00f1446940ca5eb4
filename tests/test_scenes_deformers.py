"""Theatres read from their files, and the models in them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from theatres import PUSHING, player, put, short

from scenes.cli import main
from scenes.play.deformers import open_theatre, to_model_path
from scenes.script.scene import find_scene
from scenes.script.shipped_files import get_template_path
from scenes.script.tool_paths import Touch
from sim.bodies.intensity import to_intensity_path
from sim.bodies.meshfile import write_anatomy
from sim.errors import InputError
from surrogate.model.store import save


def test_a_theatre_is_read_from_its_files(theatre, tmp_path):

    again = open_theatre(put(theatre, tmp_path / "box.vtu"), device="cpu")
    assert again.anatomy.digest == theatre.anatomy.digest and again.list_deformers(short()) == (
        "linear",
        "svr",
        "guarded",
        "fem",
    )
    assert again.intensity is not None and theatre.intensity is not None
    assert np.array_equal(again.intensity.values, theatre.intensity.values)
    assert again.select_best(short()) == min(theatre.models, key=lambda name: theatre.models[name].bound)
    touch = Touch(force=0.2)
    pictures = [player(each, short(), "linear").draw(0, 0.0, touch).shown for each in (theatre, again)]
    assert np.array_equal(pictures[0], pictures[1])
    to_intensity_path(tmp_path / "box.vtu").unlink()
    to_model_path(tmp_path / "box.vtu").unlink()
    bare = open_theatre(tmp_path / "box.vtu", device="cpu")
    assert bare.intensity is None and bare.list_deformers(short()) == ("fem",) and bare.select_best(short()) == "fem"
    with pytest.raises(InputError, match=r"'linear'.*fem; `sulcus train`"):
        bare.build_deformer("linear", short())


def test_models_of_a_scene_are_read_beside_the_others(theatre, tmp_path):
    path = put(theatre, tmp_path / "box.vtu")
    save(to_model_path(path, "spatula"), {"linear": theatre.models["svr"], "gp": theatre.models["linear"]})
    found = open_theatre(path, device="cpu").models
    assert list(found) == [*theatre.models, "linear-spatula", "gp-spatula"]
    assert found["linear-spatula"].bound == theatre.models["svr"].bound
    assert list(open_theatre(path, to_model_path(path), "cpu").models) == list(theatre.models)


def test_the_default_scene_is_one_that_a_model_supports():
    theatre = open_theatre(device="cpu")
    assert theatre.select_default_scene() == "spatula"
    assert replace(theatre, models={"ann": theatre.models["ann"]}).select_default_scene() == "press"
    assert replace(theatre, models={}).select_default_scene() == "press"


def test_files_that_do_not_belong_together_are_refused(theatre, template, tmp_path):

    put(theatre, tmp_path / "box.vtu")
    write_anatomy(tmp_path / "box.vtu", template.anatomy)
    with pytest.raises(InputError, match=f"{theatre.anatomy.digest}.*{template.anatomy.digest}"):
        open_theatre(tmp_path / "box.vtu", device="cpu")
    with pytest.raises(InputError, match=r"none\.npz: no such file"):
        open_theatre(tmp_path / "box.vtu", tmp_path / "none.npz", "cpu")
    with pytest.raises(InputError, match="no device 'abacus'"):
        open_theatre(device="abacus")


def test_what_ships_fits_together_and_passes_its_own_checks(capsys):
    assert (
        to_model_path(get_template_path()).stat().st_size <= 40_000_000
        and to_intensity_path(get_template_path()).is_file()
    )
    theatre = open_theatre(device="cpu")
    assert {"linear", "ann", "svr"} <= set(theatre.models) and theatre.intensity is not None
    assert (
        all(model.bound < 1e-3 for model in theatre.select_models(find_scene("press")).values())
        and theatre.select_best(find_scene("press")) != "fem"
    )
    assert main(["check", *PUSHING, "--every", "60", "--device", "cpu", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["passed"] and [row["scene"] for row in report["scenes"]] == list(PUSHING)
    assert "fem" not in [row["deformer"] for row in report["scenes"]]


def test_a_scene_is_played_by_a_family_that_it_names(theatre):
    scene = replace(find_scene("press"), deformer="condensed")
    assert theatre.select_default(scene) == "condensed"
    player = theatre.build_player("condensed", scene)
    frame = next(player.play_frames())
    assert frame.deformation.source.startswith("condensed (neo-hookean")
    assert "model error relative to FEM: not known" in frame.head
    assert theatre.describe_deformer("condensed", scene).startswith("linear finite elements")
    with pytest.raises(InputError, match=r"condensed does not compute Slide.*--deformer fem"):
        theatre.build_deformer("condensed", find_scene("sag"))
    with pytest.raises(InputError, match=r"no deformer is called 'rocks'.*Other families: kelvinlets"):
        theatre.build_deformer("rocks", scene)
