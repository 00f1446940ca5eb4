"""Deformed anatomies: displacement, bound and time of a frame."""

from types import SimpleNamespace

import pytest
from theatres import small, theatre_of

from scenes.play.deformers import PatientSetup
from scenes.warp.deformed_anatomy import PlayedScene


def test_warp_uses_error_bound_at_the_time_of_the_frame(box, monkeypatch):
    grows = SimpleNamespace(evaluate=lambda time: SimpleNamespace(prior=1e-3 * (1.0 + time)))
    monkeypatch.setattr(PatientSetup, "estimate_uncertainty", lambda theatre, scene: grows)
    scene = small()
    found = PlayedScene(theatre_of(box), scene).solve_frames([0, 12, len(scene.times) - 1])
    assert [one.bound for one in found] == pytest.approx([1e-3 * (1.0 + scene.times[k]) for k in (0, 12, -1)])
