"""Certificates frame by frame on the command line, and deformers that a budget chose."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from theatres import put, theatre_of

from scenes.analysis.budget import offers
from scenes.cli import main
from scenes.play.certificates import certified
from scenes.script.scene import find_scene
from sim.deformation import Cost
from sim.deformation import guess as answered
from surrogate.evaluation.certificate import SCOPE


@pytest.fixture(scope="module")
def theatre(small_box):
    return theatre_of(small_box)


@pytest.fixture(scope="module")
def anatomy(theatre, tmp_path_factory):
    return str(put(theatre, tmp_path_factory.mktemp("certified") / "box.vtu"))


def check(anatomy, *words):
    return main(["check", "press", "--anatomy", anatomy, "--every", "40", "--device", "cpu", *words])


def test_every_frame_has_its_certificate(anatomy, capsys):
    check(anatomy, "--deformer", "linear", "--certify", "--json")
    out, error = capsys.readouterr()
    (row,) = json.loads(out)["scenes"]
    assert len(row["certificates"]) == row["frames"] > 2
    loaded = [frame for frame in row["certificates"] if frame["error_mm"] > 1e-3]
    assert len(loaded) >= 2 and all(frame["sound"] for frame in row["certificates"])
    for frame in loaded:
        assert 0.8 < frame["estimate_mm"] / frame["error_mm"] < 1.25
        assert frame["corrected_mm"] < 0.2 * frame["error_mm"]
        assert min(frame["predict_ms"], frame["estimate_ms"], frame["correct_ms"]) > 0.0
    first = loaded[0]
    assert f"frame {first['frame']}: off by {first['estimate_mm']:.4f} mm as estimated" in error and SCOPE in error


def test_without_certify_nothing_is_certified(anatomy, capsys):
    check(anatomy, "--deformer", "linear", "--json")
    out, error = capsys.readouterr()
    assert "certificates" not in out and SCOPE not in error


def test_a_budget_chooses_the_deformer_and_says_which(theatre, anatomy, capsys):
    stated = {offer.name: offer for offer in offers(theatre, find_scene("press"))}
    assert set(stated) == set(theatre.names(find_scene("press"))) and all(
        offer.median_ms > 0.0 for offer in stated.values()
    )
    learnt = [offer for offer in stated.values() if offer.name != "fem"]
    assert stated["linear"].error_mm == pytest.approx(1e3 * theatre.models["linear"].bound)
    assert stated["fem"].error_mm < min(offer.error_mm for offer in learnt)
    within = 1.01 * stated["fem"].error_mm
    for words in (["--within-mm", f"{within:g}"], ["--deformer", "auto", "--within-mm", f"{within:g}"]):
        check(anatomy, *words, "--json")
        out, error = capsys.readouterr()
        assert json.loads(out)["scenes"][0]["deformer"] == "fem" and "fem (0.05 mm" in error and "fastest of 1" in error


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--deformer", "linear", "--within-mm", "0.1"], "--deformer linear leaves a budget nothing to choose"),
        (["--deformer", "auto"], "give --within-mm, --within-ms or both"),
        (["--within-mm", "1e-6"], "most accurate is fem"),
        (["--within-ms", "nan"], "positive"),
    ],
)
def test_budgets_that_buy_nothing_are_sentences(anatomy, capsys, words, reason):
    assert check(anatomy, *words) == 2
    assert reason in capsys.readouterr().err


def test_searching_is_correcting_and_the_rest_is_estimating(monkeypatch):
    """By a certificate of known seconds: each figure stands where its name is."""
    anatomy = SimpleNamespace(tumour_nodes=np.arange(2))

    def answer(x):
        return answered(np.full((1, 2, 3), x))

    def known(fem, loads, deformation):
        cost = Cost({"settle": 0.001, "solve": 0.002, "search": 0.5})
        left = np.array([2e-6]), np.array([1e-5])
        return SimpleNamespace(estimate=left[1], left=left[0], corrected=answer(3e-6), cost=cost, sound=[True])

    monkeypatch.setattr("scenes.play.certificates.certify", known)
    drawn = SimpleNamespace(number=7, loads=None, deformation=replace(answer(4e-6), cost=Cost({"predict": 0.004})))
    (found,) = certified(SimpleNamespace(anatomy=anatomy), [drawn], answer(0.0))  # type: ignore
    assert (found.predict_ms, found.estimate_ms, found.correct_ms) == pytest.approx((4.0, 3.0, 500.0))
    assert (found.estimate_mm, found.left_mm) == pytest.approx((1e-2, 2e-3))
    assert (found.error_mm, found.corrected_mm) == pytest.approx((4e-3 * 3**0.5, 3e-3 * 3**0.5))
    assert "4.0 ms to predict, 3 to estimate, 500 to correct" in str(found)
