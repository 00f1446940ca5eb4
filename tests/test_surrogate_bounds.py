"""Errors of distances, and the scale of error bounds."""

from dataclasses import replace

import numpy as np
import pytest

from sim.bodies.tip_distance import build_tip_gauge
from surrogate.data.cortex_patch import open_patch
from surrogate.data.dataset import read_dataset
from surrogate.data.indentation import get_only_pushes
from surrogate.data.simulate import simulate
from surrogate.data.splits import CALIBRATION_STRIDE
from surrogate.data.tool_loads import draw
from surrogate.training.bounds import MIN_SCALE_LOADS, TUMOUR_FIT, calibrate_bound, collect_bound_examples
from surrogate.training.train import train


class Proportional:
    """A Deformer that answers every load as its thousandth, a thousand times."""

    def __init__(self, pretender):
        self.anatomy, self.pretender = pretender.anatomy, pretender

    def deform(self, loads, start=None, at=None):
        answer = self.pretender.deform(loads.scale(1e-3), start, at)
        return replace(answer, displacement=1e3 * answer.displacement)


@pytest.mark.parametrize("count", [600, CALIBRATION_STRIDE * MIN_SCALE_LOADS])
def test_bound_scale_source_depends_on_calibration_count(pretender, tmp_path, count):
    """With few loads the scale comes from errors on held-out discs, with many from a third of the calibration."""
    simulate(tmp_path / "data.h5", pretender, draw("palpation", pretender.anatomy, count, 0), {"preset": "palpation"})
    data = read_dataset(tmp_path / "data.h5")
    trained = train(data, ["linear"])
    model, good = trained.models["linear"], data.loads.select(np.flatnonzero(data.good))
    truth = data.read_displacement(data.anatomy.tumour_nodes)[data.good]

    apart = np.arange(len(good))[-trained.calibrated :]
    answer = model.deform(good.select(apart), at=data.anatomy.tumour_nodes).displacement
    error = np.linalg.norm(answer - truth[apart], axis=2).max(axis=1)
    near = collect_bound_examples(model, open_patch(data.anatomy), get_only_pushes(good.select(apart)), error)
    bounds = calibrate_bound(near, TUMOUR_FIT, float(model.bounds.growth))
    pairs = ((model.bounds.weights, bounds.weights), (model.bounds.quantile, bounds.quantile))
    assert [np.allclose(*pair) for pair in pairs] == 2 * [trained.calibrated >= MIN_SCALE_LOADS] == 2 * [count > 600]


def test_distance_correction_without_benefit_is_omitted(box, pretender, tmp_path):
    """For linear tissue the compliance table is already exact."""
    linear = Proportional(pretender)
    simulate(tmp_path / "data.h5", linear, draw("palpation", box, 120, 0), {"preset": "palpation"})
    model = train(read_dataset(tmp_path / "data.h5"), ["linear"]).models["linear"]
    loads = draw("palpation", box, 20, 5)
    answer, gauge = linear.deform(loads), build_tip_gauge(box)
    truth = gauge.compute_distances(loads, answer.displacement, answer.nodes)
    assert np.abs(model.predict_distance(loads).distance - truth).max() < 2e-5
