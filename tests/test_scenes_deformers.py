"""Patient setups read from files, and the models in them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from theatres import PUSHING, player, put, short

from scenes.analysis.budget import choose_within
from scenes.cli import main
from scenes.play.deformers import open_theatre, to_model_path
from scenes.play.family_record import read_family_figures
from scenes.script.scene import find_scene
from scenes.script.shipped_files import get_template_path
from scenes.script.tool_paths import Touch
from sim.bodies.intensity import to_intensity_path
from sim.bodies.meshfile import write_anatomy
from sim.effects import Elasticity, Gravity, Held, ToolForce
from sim.errors import InputError
from sim.families.registry import FAMILIES
from sim.material import Material
from surrogate.model.store import save


def test_patient_setup_is_read_from_its_files(theatre, tmp_path):

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


def test_open_theatre_also_reads_models_of_one_scene(theatre, tmp_path):
    path = put(theatre, tmp_path / "box.vtu")
    save(to_model_path(path, "spatula"), {"linear": theatre.models["svr"], "gp": theatre.models["linear"]})
    found = open_theatre(path, device="cpu").models
    assert list(found) == [*theatre.models, "linear-spatula", "gp-spatula"]
    assert found["linear-spatula"].bound == theatre.models["svr"].bound
    assert list(open_theatre(path, to_model_path(path), "cpu").models) == list(theatre.models)


def test_default_scene_is_supported_by_a_model():
    theatre = open_theatre(device="cpu")
    assert theatre.select_default_scene() == "spatula"
    assert replace(theatre, models={"ann": theatre.models["ann"]}).select_default_scene() == "press"
    assert replace(theatre, models={}).select_default_scene() == "press"


def test_open_theatre_rejects_model_of_another_anatomy(theatre, template, tmp_path):

    put(theatre, tmp_path / "box.vtu")
    write_anatomy(tmp_path / "box.vtu", template.anatomy)
    with pytest.raises(InputError, match=f"{theatre.anatomy.digest}.*{template.anatomy.digest}"):
        open_theatre(tmp_path / "box.vtu", device="cpu")
    with pytest.raises(InputError, match=r"none\.npz: no such file"):
        open_theatre(tmp_path / "box.vtu", tmp_path / "none.npz", "cpu")
    with pytest.raises(InputError, match="no device 'abacus'"):
        open_theatre(device="abacus")


def test_template_files_match_and_pass_the_checks(capsys):
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


def test_scene_uses_its_selected_deformer_family(theatre):
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


ROW = {"name": "condensed", "median": 1e-3, "set_up": 1.0, "reference": {"loads": 64, "worst": {"p95": 1e-3}}}


def write_report(path, digest, **change):
    """Write a report of a family that is more accurate than any model, and faster than it can be."""
    part = {
        "anatomy": digest,
        "tissue": "neo-hookean, E 3 kPa, nu 0.49",
        "rows": [ROW | change, {**ROW, "name": "FEM"}],
    }
    path.write_text(json.dumps({"machine": "a card, 16 cores", "sections": [part]}))


def test_family_within_error_limit_is_timed_and_selected(theatre, tmp_path):
    scene, said = short(), []
    put(theatre, tmp_path / "box.vtu")
    write_report(tmp_path / "box.report.json", theatre.anatomy.digest)
    here = open_theatre(tmp_path / "box.vtu", device="cpu")
    offer = choose_within(here, scene, (1e-3, None), said.append).candidate
    assert offer.name == "condensed" and offer.median_ms > ROW["median"] and "64 recorded pushes" in str(offer)
    assert len(said) == 1 and "0.001 ms" in said[0] and "time of a card" in said[0]
    frame = here.build_player("condensed", scene).draw(0, 0.0, Touch(force=0.2))
    assert " ".join(frame.head).startswith("model <= 0.01 mm")
    assert here.family_figures["condensed"].describe_error(brief=False).endswith("(95 % of 64 pushes, relative to p2)")
    assert len(here.families) == 1  # built once
    with pytest.raises(InputError, match=r"no deformer here is within 0\.001 mm and 0\.001 ms: .* condensed"):
        choose_within(here, scene, (1e-3, 1e-3), said.append)


def test_families_without_recorded_errors_are_not_offered(theatre, tmp_path):
    write_report(tmp_path / "box.report.json", theatre.anatomy.digest)
    assert read_family_figures(tmp_path / "box.vtu", "another") == read_family_figures(tmp_path / "no.vtu", "") == {}
    figures = read_family_figures(tmp_path / "box.vtu", theatre.anatomy.digest)
    here, said = replace(theatre, models={}, family_figures=figures), []
    for scene in (
        replace(short(), effects=(*short().effects, Gravity())),
        replace(short(), effects=(Elasticity(Material("neo-hookean", 900.0, 0.49)), Held(), ToolForce())),
    ):
        assert choose_within(here, scene, (1.0, None), said.append).candidate.name == "fem"
    assert len(said) == 2 and all("`sulcus report --anatomy MESH.vtu`" in words for words in said)


BROKEN = (
    {"median": float("nan")}, {"median": 1e300}, {"median": -1.0}, {"set_up": "1"}, {"median": True}, {"set_up": None},
    {"reference": {"loads": 64}}, {"reference": {"loads": 0.5, "worst": {"p95": 1.0}}}, {"reference": 5}, {"name": []},
)  # fmt: skip


@pytest.mark.parametrize("change", BROKEN)
def test_damaged_report_of_families_is_rejected(tmp_path, change):
    write_report(tmp_path / "box.report.json", "1", **change)
    with pytest.raises(InputError, match=r"box.report.json: cannot be read as a report: .*Delete it\. `sulcus report"):
        read_family_figures(tmp_path / "box.vtu", "1")


def test_template_report_matches_benchmark_record_of_families(template):
    figures = open_theatre(device="cpu").select_recorded(find_scene("press"))
    recorded = json.loads((Path(__file__).parents[1] / "benchmarks/records/families.json").read_text())["figures"]
    assert list(figures) == list(FAMILIES)
    for name, one in figures.items():
        assert (one.median_ms, one.preparation_s) == (recorded[name]["time [ms]"], recorded[name]["preparation [s]"])
        assert one.p95_mm > recorded[name]["error [mm]"]
