"""Tracking checks of `sulcus check`: perturbed code for lost, found and stale images fails."""

import json
from dataclasses import replace

import numpy as np
import pytest
from theatres import template_theatre

from scenes.cli import main
from scenes.tracked.follower import Follower, TumourState
from scenes.tracked.overlay_painter import Painter
from scenes.tracked.rendered_video import render_synthetic_video
from scenes.tracked.tracking_checks import TrackingFigures, build_default_pipeline, measure_tracking


@pytest.fixture(scope="module")
def film():
    return render_synthetic_video(template_theatre())


@pytest.fixture(scope="module")
def parts(film):
    return build_default_pipeline(film, "contour")


def as_known(known):
    return replace(known, state=TumourState.GOOD, warning="")


def made(kind, whole):
    """The same follower or painter, as another class."""
    return kind(**{name: value for name, value in vars(whole).items() if name in kind.__dataclass_fields__})


class Sure(Follower):
    """Says that it knows the tumour's place while reference or tool are lost."""

    def track(self, grey, time, before=None):
        known = super().track(grey, time, before)
        return as_known(known) if known.state in (TumourState.NO_REFERENCE, TumourState.NO_TOOL) else known


class Blind(Follower):
    """Finds nothing again that it lost."""

    def track(self, grey, time, before=None):
        lost = before is not None and before.state is TumourState.NO_REFERENCE
        return super().track(np.full_like(grey, 120) if lost else grey, time, before)


class Frozen(Follower):
    """Goes on with the camera of the first picture."""

    def track(self, grey, time, before=None):
        known = super().track(grey, time, before)
        return known if before is None or before.camera is None else replace(known, camera=before.camera)


class Fresh(Painter):
    """Draws what is stale as if it were known."""

    def paint(self, colour, known, covered=None):
        return super().paint(colour, as_known(known) if known.state is TumourState.STALE else known, covered)


class Silent(Painter):
    """Does not say why."""

    def paint(self, colour, known, covered=None):
        return super().paint(colour, replace(known, warning=""), covered)


def test_unperturbed_tracking_passes_the_checks(film, parts):
    figures = measure_tracking(film, *parts)
    assert figures.find_violations() == []
    assert figures.pictures == 16 and figures.confident == figures.unsaid == 0 and figures.back <= 3
    assert 0.0 < figures.off < 1.6


@pytest.mark.parametrize(
    ("follower", "painter", "broken"),
    [
        (Sure, Painter, "draw a lost or old position as if it were known"),
        (Blind, Painter, "back after inf images"),
        (Frozen, Painter, "pixels off, more than 2"),
        (Follower, Fresh, "draw a lost or old position as if it were known"),
        (Follower, Silent, "do not say that something is lost or old"),
    ],
)
def test_each_perturbation_fails_its_tracking_check(film, parts, follower, painter, broken):
    figures = measure_tracking(film, made(follower, parts[0]), made(painter, parts[1]))
    assert any(broken in sentence for sentence in figures.find_violations())


def test_registration_shifted_by_2_mm_fails_the_checks(film, parts):
    T = parts[0].registration.T_patient_scan.copy()
    T[:3, 3] += T[:3, :3] @ (2e-3 * film.stage.site.right)
    off = replace(parts[0], registration=replace(parts[0].registration, T_patient_scan=T))
    (sentence,) = measure_tracking(film, off, parts[1]).find_violations()
    assert "pixels off" in sentence


def test_tracking_that_never_recovers_fails_the_checks():
    never = TrackingFigures(1, 0, 0, np.inf, 0.0)
    assert never.to_row()["back"] is None and len(never.find_violations()) == 1


def test_check_exit_status_is_1_where_tracking_alone_fails(film, parts, monkeypatch, capsys):
    names = {"rendered_video.render_synthetic_video": film, "tracking_checks.build_default_pipeline": parts}
    names["tracking_checks.measure_tracking"] = TrackingFigures(16, 1, 0, 0.0, 0.0)
    for name, found in names.items():
        monkeypatch.setattr(f"scenes.tracked.{name}", lambda *given, found=found: found)
    assert main(["check", "tracking", "--device", "cpu", "--json"]) == 1
    said = json.loads(capsys.readouterr().out)
    assert not said["passed"] and said["scenes"] == [] and len(said["tracking"]["broken"]) == 1
