"""What a scored model knows of the discs of cortex that it is held to, which is nothing."""

from dataclasses import replace

import numpy as np
import pytest
from poison import poisoned

from sim.loads import Loads, Pushed
from surrogate.data.cortex_patch import open_patch
from surrogate.data.dataset import read_dataset
from surrogate.data.simulate import simulate
from surrogate.data.tool_loads import draw
from surrogate.training.train import train


@pytest.fixture(scope="module")
def data(tmp_path_factory, pretender):
    path = tmp_path_factory.mktemp("left-out") / "data.h5"
    simulate(path, pretender, draw("palpation", pretender.anatomy, 120, 0), {"preset": "palpation"})
    return read_dataset(path)


@pytest.fixture(scope="module")
def trained(data):
    return train(data, ["linear"])


@pytest.fixture(scope="module")
def scored(data, trained):
    return train(data, ["linear"], split=trained.split).models["linear"]


def test_nothing_of_held_out_loads_reaches_an_envelope(trained, scored, data):
    """Bit for bit, wherever they lie and however strong they are."""
    rows = np.flatnonzero(~trained.split.train)
    pushed = data.loads.of(Pushed)
    moved = Pushed(pushed.point.copy(), pushed.force.copy(), pushed.footprint.copy())
    moved.point[rows], moved.force[rows] = np.roll(pushed.point[rows], 1, axis=0), 2.0 * pushed.force[rows]
    moved.footprint[rows] *= 1.1
    again = train(replace(data, loads=Loads((moved,))), ["linear"], split=trained.split).models["linear"].envelope
    assert all(np.array_equal(value, vars(again)[name]) for name, value in vars(scored.envelope).items())


def test_no_unit_response_inside_a_disc_reaches_a_scored_tumour(trained, scored, data, box, tmp_path):
    """Bit for bit; of the cortex, which is not scored, all are given."""
    patch = open_patch(box)
    inside = np.flatnonzero(trained.split.covers(patch.points))
    assert 0 < len(inside) < len(patch.points)
    rows = (3 * inside[:, None] + np.arange(3)).ravel()
    wild, _ = poisoned(data.path, tmp_path / "wild.h5", rows, "unit")
    again = train(read_dataset(wild), ["linear"], split=trained.split).models["linear"]
    (tumour, cortex), (tumour_again, cortex_again) = scored.parts, again.parts
    assert np.array_equal(tumour.basis.modes, tumour_again.basis.modes)
    assert np.array_equal(tumour.regressor.compliance_, tumour_again.regressor.compliance_)
    assert not np.array_equal(cortex.basis.modes, cortex_again.basis.modes)
    # What is interpolated is near what is not given.
    every, size = trained.models["linear"].parts[0], np.linalg.norm
    given = [part.response(np.eye(3 * len(patch.points))[rows]) for part in (tumour, every)]
    assert 1e-3 * size(given[1]) < size(given[0] - given[1]) < 0.15 * size(given[1])
