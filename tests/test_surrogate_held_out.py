"""Data from held-out discs in scored models: linear responses, but no displacements of loads."""

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


def test_envelope_is_independent_of_held_out_loads(trained, scored, data):
    """Bit-identical for other positions and forces of held-out loads."""
    rows = np.flatnonzero(~trained.split.training_mask)
    pushed = data.loads.get(Pushed)
    moved = Pushed(pushed.point.copy(), pushed.force.copy(), pushed.footprint.copy())
    moved.point[rows], moved.force[rows] = np.roll(pushed.point[rows], 1, axis=0), 2.0 * pushed.force[rows]
    moved.footprint[rows] *= 1.1
    again = train(replace(data, loads=Loads((moved,))), ["linear"], split=trained.split).models["linear"].envelope
    assert all(np.array_equal(value, vars(again)[name]) for name, value in vars(scored.envelope).items())


def test_unit_responses_inside_held_out_discs_are_counted(trained, data, box):
    """Linear tissue is known everywhere: the table is exact for unit forces in the discs, and the row counts them."""
    inside = int(trained.split.is_covered(open_patch(box).points).sum())
    assert inside and trained.scores[0].solves.inside == 3 * inside
    model = train(data, ["linear"], split=trained.split).models["linear"]
    patch = open_patch(box)
    unit = data.compute_unit_response(box.tumour_nodes).reshape(len(patch.points), 3, -1, 3)
    for node in np.flatnonzero(trained.split.is_covered(patch.points))[:3]:
        force = np.zeros(3 * len(patch.points))
        force[3 * node + 2] = 1.0
        found = model.parts[0].compute_response(force[None])[0]
        np.testing.assert_allclose(found, unit[node, 2], atol=2e-3 * np.abs(unit[node, 2]).max())


def test_learners_without_table_ignore_unit_responses(trained, data, tmp_path):
    """Bit-identical: random unit responses change only the cortex part, which is not scored."""
    rows = np.arange(len(data.unit_good))
    wild, _ = poisoned(data.path, tmp_path / "wild.h5", rows, "unit")
    known, again = (train(each, ["gp"], split=trained.split) for each in (data, read_dataset(wild)))
    (tumour, cortex), (tumour_again, cortex_again) = known.models["gp"].parts, again.models["gp"].parts
    assert np.array_equal(tumour.basis.modes, tumour_again.basis.modes)
    assert np.array_equal(tumour.regressor.dual_, tumour_again.regressor.dual_)
    assert not np.array_equal(cortex.basis.modes, cortex_again.basis.modes)
    assert known.scores[0].solves.inside == 0
