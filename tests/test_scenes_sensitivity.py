"""Sensitivity of the tumour's motion: changes of known size, and loads without convergence."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import make_box
from theatres import knowing_nothing

from scenes.analysis.sensitivity import (
    BodyVariant,
    LoadPerturbation,
    SensitivityStudy,
    compute_change,
    list_variants,
    match_motion,
    measure_variants,
    perturb_loads,
)
from scenes.cli import main
from sim.accuracy import Accuracy
from sim.anatomy import TUMOUR_LABEL
from sim.bodies.meshfile import write_anatomy
from sim.deformation import Outcome, build_start
from sim.discretisation.footprint import compute_footprint_weights
from sim.effects import Bonded, Elasticity, Held, ToolForce
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Displaced, Pushed, push
from sim.material import Material
from surrogate.data.cortex_patch import open_patch
from surrogate.data.tool_loads import draw
from surrogate.model.store import save

TIGHT = Accuracy(tolerance=1e-9)
LINEAR = BodyVariant(Material("linear", 3000.0, 0.45), element="p1")


@pytest.fixture(scope="module")
def anatomy():
    """A small box whose sides slide."""
    box = make_box(cells=(8, 8, 5), spacing=9e-3, tumour=12e-3, opening=27e-3)
    nodes = box.mesh.nodes
    normal, held = np.zeros_like(nodes), box.fixed.copy()
    for axis in (0, 1):
        side = (np.abs(nodes[:, axis]) > 36e-3 - 1e-9) & (nodes[:, 2] > -45e-3 + 1e-9) & ~normal.any(axis=1)
        normal[side, axis] = 1.0
        held[side] = False
    return replace(box, fixed=held, slide_normal=normal)


@pytest.fixture(scope="module")
def found(anatomy):
    """All rows of the linear law, by factor and changed value."""
    study = SensitivityStudy(anatomy, draw("palpation", anatomy, 4, 0), LINEAR, TIGHT, "cpu")
    all_rows = list(measure_variants(study, list_variants(anatomy, LINEAR, ["smoothed"])))
    return {(row.variant.factor, row.variant.changed): row for row in all_rows}


def test_sensitivity_study_has_one_row_per_variant(found):
    assert list(found) == [
        ("motion itself", ""), ("force or motion", "+-5 %"), ("its direction", "+-2 deg"),
        ("its position", "+-1 mm"), ("E", "-20%"), ("E", "+20%"), ("nu", "0.49"), ("nu", "0.495"),
        ("law", "neo-hookean"), ("law", "ogden"),
        ("tumour's stiffness", "0.5 x"), ("tumour's stiffness", "2 x"), ("tumour's stiffness", "3 x"),
        ("skull", "slide"), ("skull", "contact"), ("element", "smoothed"),
    ]  # fmt: skip
    for row in found.values():
        for one in (row.force, row.motion):
            assert one.failed == 0
            assert max(one.mean_mm, one.p95_mm, one.worst95_mm) <= one.largest_mm
    ways = [row.force.solves // 4 for row in found.values()]
    assert ways == [1, 2, 2, 4] + [1] * 12


@pytest.mark.parametrize(("now", "factor"), [("-20%", 1.0 / 0.8), ("+20%", 1.0 / 1.2)])
def test_stiffness_changes_motion_under_known_force_only(found, now, factor):
    """Displacement is inversely proportional to E under dead forces and independent of E under prescribed motion."""
    row = found["E", now]
    assert row.force.motion == pytest.approx(factor, rel=1e-6)
    assert row.force.percent == pytest.approx(100.0 * abs(factor - 1.0), rel=1e-5)
    assert row.motion.largest_mm < 1e-6
    assert row.motion.motion == pytest.approx(1.0, rel=1e-7)


def test_linear_body_has_displacement_proportional_to_load(found):
    for one in (found["force or motion", "+-5 %"].force, found["force or motion", "+-5 %"].motion):
        assert one.percent == pytest.approx(5.0, rel=1e-6)
        assert one.motion == pytest.approx(1.0, rel=1e-7)
        assert one.mean_mm == pytest.approx(0.05 * found["motion itself", ""].force.mean_mm, rel=1e-6)


def test_default_motion_and_force_give_equal_displacement(found):
    """Both defaults are the same field."""
    whole = found["motion itself", ""]
    assert whole.force.percent == pytest.approx(100.0)
    assert whole.motion.mean_mm == pytest.approx(whole.force.mean_mm, rel=1e-6)
    assert whole.motion.largest_mm == pytest.approx(whole.force.largest_mm, rel=1e-6)


def test_softer_tumour_and_looser_skull_increase_motion(found):
    motion = [found["tumour's stiffness", now].force.motion for now in ("0.5 x", "2 x", "3 x")]
    assert motion[0] > 1.0 > motion[1] > motion[2]
    assert 1.0 < found["skull", "slide"].force.motion < found["skull", "contact"].force.motion


@pytest.mark.parametrize(("now", "times"), [("0.5 x", 0.5), ("3 x", 3.0)])
def test_stiff_tumour_variant_changes_only_the_tumour(found, anatomy, now, times):
    """Against FEM with two tissues, assembled here."""
    brain = Material("linear", 3000.0, 0.45)
    tumour = Material("linear", times * 3000.0, 0.45)
    rest = (Held(), Bonded(), ToolForce())
    default, changed = (
        Fem(anatomy, (Elasticity(brain, regions), *rest), TIGHT, "cpu", element="p1")
        .deform(draw("palpation", anatomy, 4, 0))
        .restrict(anatomy.tumour_nodes)
        .displacement
        for regions in ({}, {TUMOUR_LABEL: tumour})
    )
    motion = [np.linalg.norm(field, axis=2).mean() for field in (changed, default)]
    row = found["tumour's stiffness", now].force
    assert row.motion == pytest.approx(motion[0] / motion[1], rel=1e-6)
    assert row.mean_mm == pytest.approx(1e3 * np.linalg.norm(changed - default, axis=2).mean(), rel=1e-5)


def test_loads_without_convergence_are_counted_and_omitted(anatomy):
    """With an iteration budget too small for each load."""
    few = Accuracy(tolerance=1e-9, outer=1, inner=1, steps=0)
    study = SensitivityStudy(anatomy, draw("palpation", anatomy, 3, 0), BodyVariant(element="p1"), few, "cpu")
    one = next(measure_variants(study, []))
    assert (one.force.solves, one.force.failed) == (0, 3)
    assert np.isnan(one.force.mean_mm)


def test_change_uses_loads_converged_in_variant_and_default(pretender):
    loads = push(np.zeros((3, 3)), np.array([[0.0, 0.0, -f] for f in (0.1, 0.2, 0.3)]), 7e-3)
    nodes = pretender.anatomy.tumour_nodes
    default, answer = (replace(pretender, fails_above=most).deform(loads, at=nodes) for most in (0.25, 0.15))
    assert [outcome is Outcome.CONVERGED for outcome in default.outcome] == [True, True, False]
    doubled = replace(answer, displacement=2.0 * answer.displacement)
    found = compute_change(doubled, default, default.displacement)
    assert (found.solves, found.failed) == (1, 2)
    assert found.percent == pytest.approx(100.0)
    assert found.motion == pytest.approx(2.0)
    assert found.mean_mm == pytest.approx(1e3 * np.linalg.norm(default.displacement[0], axis=1).mean())
    all_good = compute_change(pretender.deform(loads, at=nodes), default, default.displacement)
    assert (all_good.solves, all_good.failed) == (2, 1)


def test_change_has_percentiles_over_loads_and_vertices():
    """p95 over every load x vertex; worst95 over the loads, each by its farthest vertex."""
    field = np.random.default_rng(0).normal(size=(40, 7, 3))
    default = replace(build_start(np.ones((40, 7, 3))), outcome=40 * (Outcome.CONVERGED,))
    found = compute_change(replace(default, displacement=1.0 + 1e-3 * field), default, default.displacement)
    off = np.linalg.norm(field, axis=2)
    wanted = off.mean(), np.percentile(off, 95), np.percentile(off.max(axis=1), 95), off.max()
    assert (found.mean_mm, found.p95_mm, found.worst95_mm, found.largest_mm) == pytest.approx(wanted)


def test_aim_errors_have_the_given_angle_and_shift(anatomy):
    loads, patch = draw("palpation", anatomy, 5, 1), open_patch(anatomy)
    drawn = loads.get(Pushed)
    size = np.linalg.norm(drawn.force, axis=1)
    turned = perturb_loads(loads, LoadPerturbation(turn=0.2), patch).get(Pushed)
    shifted = perturb_loads(loads, LoadPerturbation(shift=1e-3), patch).get(Pushed)
    assert (len(turned.force), len(shifted.force)) == (10, 20)
    np.testing.assert_allclose(np.linalg.norm(turned.force, axis=1), np.tile(size, 2))
    cosine = np.einsum("bi,bi->b", turned.force, np.tile(drawn.force, (2, 1))) / np.tile(size, 2) ** 2
    np.testing.assert_allclose(np.arccos(cosine), 0.2)
    away = (turned.force - np.cos(0.2) * np.tile(drawn.force, (2, 1))).reshape(2, 5, 3)
    np.testing.assert_allclose(np.einsum("bi,bi->b", *away), 0.0, atol=1e-15)
    off = shifted.point.reshape(4, 5, 3) - drawn.point
    np.testing.assert_allclose(np.linalg.norm(off, axis=2), 1e-3)
    np.testing.assert_allclose(off[..., 2], 0.0, atol=1e-15)  # the cortex of this body is level
    np.testing.assert_allclose(off.sum(axis=0), 0.0, atol=1e-15)
    np.testing.assert_array_equal(shifted.force, np.tile(drawn.force, (4, 1)))


def test_prescribed_motion_is_mean_over_the_footprint(box, pretender):
    loads = draw("palpation", box, 2, 0)
    answer = pretender.deform(loads)
    moved, pushed = match_motion(box, loads, answer).get(Displaced), loads.get(Pushed)
    weight = compute_footprint_weights(box.mesh.nodes, box.mesh.surface, pushed.point, pushed.footprint)
    for row in range(2):
        np.testing.assert_allclose(moved.displacement[row], (weight[[row]] @ answer.displacement[row])[0])
    with pytest.raises(InputError, match="Pushed"):
        match_motion(box, match_motion(box, loads, answer), answer)


def test_body_without_tumour_is_rejected(anatomy):
    whole = replace(anatomy, mesh=replace(anatomy.mesh, region=np.ones_like(anatomy.mesh.region)))
    with pytest.raises(InputError, match="no tumour"):
        next(measure_variants(SensitivityStudy(whole, draw("palpation", anatomy, 1, 0), BodyVariant()), []))


def trained(anatomy):
    """A model that knows nothing but its bound."""
    return knowing_nothing(anatomy, {"learner": "table", "preset": "bipolar", "element": "p2"})


def test_sensitivity_command_reports_all_rows(tmp_path, capsys):
    """Each figure is in the file, together with the surrogate's error or that it is unknown."""
    body = make_box(cells=(5, 5, 3), spacing=15e-3, tumour=16e-3, opening=40e-3)
    write_anatomy(tmp_path / "box.vtu", body)
    words = ["sensitivity", "--anatomy", str(tmp_path / "box.vtu"), "--count", "2", "--element", "p1"]
    assert main([*words, "--device", "cpu", "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert main([*words, "--count", "0"]) == 2
    assert "--count >= 1" in capsys.readouterr().err
    assert reported["surrogate"] is None and reported["failed"] == 0
    save(tmp_path / "box.model.npz", {"table": trained(body)})
    assert main([*words, "--device", "cpu", "--out", str(tmp_path / "table.csv")]) == 0
    said = capsys.readouterr().out
    for text in (
        "| force or motion    | as drawn    | +-5 %     |",
        "| surrogate's error  |             | table     |        | 0.123  |",
        "held-out bipolar loads", "FEM with element p2", "--compare p2", "This anatomy has no skull",
        "Use --element smoothed",
    ):  # fmt: skip
        assert text in said
    assert max(len(line) for line in said.splitlines() if line.startswith("|")) <= 120
    with open(tmp_path / "table.csv", newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["what"] for row in reported["rows"]] == [row["what"] for row in table]
    assert float(table[1]["force mean_mm"]) == reported["rows"][1]["force mean_mm"] > 0.0


@pytest.mark.parametrize(
    ("words", "reason"), [(["--out", "table.txt"], ".csv"), (["--anatomy", "none.vtu"], "no such file")]
)
def test_sensitivity_command_rejects_bad_input(words, reason, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["sensitivity", *words]) == 2
    assert reason in capsys.readouterr().err
