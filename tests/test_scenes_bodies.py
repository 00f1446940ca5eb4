"""Regions of an own anatomy in a plan: they are drawn as so many times as stiff, and what is not there is not said."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_box

from scenes.episodes.bodies import read_body, tissue_of, write_body
from scenes.episodes.plan import load_plan
from sim.anatomy import PART_LABELS, TUMOUR_LABEL
from sim.bodies.meshfile import write_anatomy

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


def test_a_body_is_made_of_what_is_drawn_for_its_regions(plan, tmp_path):
    write_body(tmp_path / "made", plan, 1, 0, "cpu")
    body = read_body(tmp_path / "made")
    young = {label: tissue.young for label, tissue in body.tissue.regions.items()}
    oedema = young.pop(PART_LABELS["oedema"])
    assert young == {TUMOUR_LABEL: 6000.0, PART_LABELS["necrosis"]: 3000.0} and 800.0 <= oedema <= 1200.0
    assert oedema == 2000.0 * body.drawn["bodies.tissue.oedema_ratio"]
    assert "bodies.tissue.ventricles_ratio" not in body.drawn


def test_a_body_that_was_made_before_has_no_such_regions(plan, tmp_path):
    write_body(tmp_path / "made", plan, 1, 0, "cpu")
    older = {name: value for name, value in read_body(tmp_path / "made").drawn.items() if "oedema" not in name}
    assert PART_LABELS["oedema"] not in tissue_of(older).regions
