"""Regions of an anatomy in a plan: sampled stiffness, and weak models in the data sheet."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from conftest import make_box
from tiny_episodes import write_episode

from scenes import write_card
from scenes.cli import main
from scenes.episodes.bodies import describe_weak, get_tissue, list_model_errors, read_body, to_weak_json, write_body
from scenes.episodes.make import make_body, to_body_path
from scenes.episodes.plan import load_plan
from sim.anatomy import PART_LABELS, TUMOUR_LABEL
from sim.bodies.meshfile import write_anatomy
from surrogate.model.held_out import MAX_VERTEX_ERROR, HeldOutErrors, ReportedErrors
from surrogate.model.store import load, read_reported_errors

PLAN = """title = "A box"
[motion.press]
[bodies]
anatomies = "box.vtu"
[bodies.learner]
name = "none"
[bodies.tissue]
young_pa = 2000
tumour_ratio = 3
oedema_ratio = [0.4, 0.6]
ventricles_ratio = 0.1
necrosis_ratio = 0.5
"""
TWO_BODIES = """
title = "A box"
seconds = 0.2
frames_per_second = 10.0
size = [32, 32]
[motion.press]
force_n = [0.01, 0.02]
[bodies]
anatomies = "box.vtu"
[bodies.tissue]
young_pa = 1500
[bodies.learner]
name = "linear"
loads = 60
"""


@pytest.fixture
def plan(tmp_path):
    """Of a box that has oedema and necrosis, and no ventricles."""
    box = make_box(cells=(5, 5, 4), spacing=12e-3, tumour=16e-3)
    region, tumour = box.mesh.region.copy(), np.flatnonzero(box.in_tumour)
    region[tumour[:3]] = PART_LABELS["necrosis"]
    region[np.flatnonzero(~box.in_tumour)[:9]] = PART_LABELS["oedema"]
    write_anatomy(tmp_path / "box.vtu", replace(box, mesh=replace(box.mesh, region=region)))
    (tmp_path / "own.toml").write_text(PLAN)
    return load_plan(str(tmp_path / "own.toml"))


def test_body_has_the_sampled_stiffness_of_its_regions(plan, tmp_path):
    write_body(tmp_path / "made", plan, 1, 0, "cpu")
    body = read_body(tmp_path / "made")
    young = {label: tissue.young for label, tissue in body.tissue.regions.items()}
    oedema = young.pop(PART_LABELS["oedema"])
    assert young == {TUMOUR_LABEL: 6000.0, PART_LABELS["necrosis"]: 3000.0} and 800.0 <= oedema <= 1200.0
    assert oedema == 2000.0 * body.parameters["bodies.tissue.oedema_ratio"]
    assert "bodies.tissue.ventricles_ratio" not in body.parameters


def test_tissue_of_older_body_file_has_no_oedema_region(plan, tmp_path):
    write_body(tmp_path / "made", plan, 1, 0, "cpu")
    older = {name: value for name, value in read_body(tmp_path / "made").parameters.items() if "oedema" not in name}
    assert PART_LABELS["oedema"] not in get_tissue(older).regions


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a body whose learner knows no more than linear tissue, and its anatomy."""
    above, anatomy = tmp_path_factory.mktemp("weak"), make_box(cells=(6, 6, 4), spacing=12e-3)
    write_anatomy(above / "box.vtu", anatomy)
    (above / "own.toml").write_text(TWO_BODIES)
    assert not make_body(above / "set", load_plan(str(above / "own.toml")), 1, 0, "cpu").failed
    return above / "set", anatomy


def test_reported_errors_above_the_limit_mark_a_weak_model():
    def left_out(mean, p999=None):
        return ReportedErrors(1.0, HeldOutErrors(mean, 0.0, p999, 0.0))

    assert (
        not ReportedErrors(MAX_VERTEX_ERROR, None).is_weak
        and ReportedErrors(1.1 * MAX_VERTEX_ERROR, None).is_weak
        and ReportedErrors(math.nan, None).is_weak
    )
    assert not left_out(0.01).is_weak and left_out(0.02).is_weak and left_out(0.01, 3e-4).is_weak
    assert str(ReportedErrors(4e-4, None)) == "maximum error up to 0.4 mm in 95 % of loads (limit 0.2 mm)"
    assert str(left_out(0.042)) == "mean error 4.2 % of the motion (limit 1 %)"
    assert str(left_out(0.042, 3e-4)).endswith("); 99.9th percentile 0.3 mm (limit 0.2 mm)")


def test_weak_models_are_listed_worst_first_and_truncated():
    many = {number: ReportedErrors(1e-5 * number, None) for number in range(35)}
    first, *named = describe_weak(many)
    assert first.startswith("14 of 35 bodies with a model have a weak one")
    assert named[0] == f"- body 34: {many[34]}" and len(named) == 11 and named[-1] == "- and 4 more"
    assert describe_weak({0: ReportedErrors(0.0, None)}) == [] == to_weak_json({0: ReportedErrors(0.0, None)})


def test_model_errors_are_read_from_model_files(made):
    folder, anatomy = made
    path = to_body_path(folder, 0) / "anatomy.model.npz"
    (model,) = load(path, anatomy).values()
    (to_body_path(folder, 1)).mkdir()  # of a body that plays by another's model there is none
    assert (
        read_reported_errors(path) == {"linear": ReportedErrors(model.bound, model.held_out)}
        and model.bound > MAX_VERTEX_ERROR
    )
    assert list_model_errors(folder) == {0: ReportedErrors(model.bound, None)}
    to_body_path(folder, 1).rmdir()


def test_datasheet_and_validate_list_weak_models(made, capsys):
    folder, _ = made
    write_episode(folder / "episode_000000.h5", made[1])
    bound = f"- body 0: {list_model_errors(folder)[0]}"
    write_card(folder)
    assert bound in (folder / "DATASHEET.md").read_text()
    assert main(["validate", str(folder), "--workers", "1"]) == 0
    assert (
        f"{folder}: 1 of 1 bodies with a model have a weak one" in (said := capsys.readouterr().out) and bound in said
    )
    assert main(["validate", str(folder), "--workers", "1", "--json"]) == 0
    (weak,) = json.loads(capsys.readouterr().out)["weak_bodies"][str(folder)]
    assert weak["body"] == 0 and weak["bound_mm"] == pytest.approx(1e3 * list_model_errors(folder)[0].bound)
    words = ["episodes", str(folder.parent / "own.toml"), "--count", "1", "--seed", "1", "--out", str(folder)]
    words += ["--workers", "1", "--device", "cpu", "--force"]
    assert main(words) == 0 and bound in capsys.readouterr().out
    assert main([*words, "--json"]) == 0 and json.loads(capsys.readouterr().out)["weak_bodies"] == [weak]
