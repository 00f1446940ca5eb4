"""Accuracy presets: error against the converged displacement on the example scene."""

import numpy as np
import pytest

from scenes.play.deformers import open_theatre
from scenes.script.scene import find_scene
from sim.accuracy import LIVE, TRAIN, Accuracy
from sim.fem import Fem
from sim.loads import stack

# Largest distance over all nodes from the converged solution [m].
PROMISED = {"live": (LIVE, 5e-5), "train": (TRAIN, 5e-6)}


@pytest.fixture(scope="module")
def press():
    """Anatomy, effects and the loads of the press scene, while the force rises and while it falls."""
    scene, theatre = find_scene("press"), open_theatre()
    times = (0.3, 1.2, 2.6)
    loads = stack([scene.build_loads(theatre.site, scene.path(time), time) for time in times])
    converged = Fem(theatre.anatomy, scene.effects, Accuracy(1e-7), "cpu", element="p1").deform(loads)
    assert all(outcome.good for outcome in converged.outcome)
    return theatre.anatomy, scene.effects, loads, converged.displacement


@pytest.mark.parametrize("name", PROMISED)
def test_accuracy_preset_meets_its_error_bound(press, name):
    anatomy, effects, loads, converged = press
    accuracy, bound = PROMISED[name]
    answer = Fem(anatomy, effects, accuracy, "cpu", element="p1").deform(loads).displacement
    assert np.linalg.norm(answer - converged, axis=2).max() <= bound


def test_warm_starts_meet_error_bound_of_live_preset(press):
    anatomy, effects, loads, converged = press
    fem, last = Fem(anatomy, effects, LIVE, "cpu", element="p1"), None
    for row in range(len(loads)):
        last = fem.deform(loads.select(np.array([row])), start=last)
        assert np.linalg.norm(last.displacement[0] - converged[row], axis=1).max() <= PROMISED["live"][1]
