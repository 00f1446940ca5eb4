"""Range of loads in the training of a model."""

import numpy as np
import pytest

from sim.loads import Pushed, push
from surrogate.data.cortex_patch import open_patch
from surrogate.model.training_range import LoadMeasures, TrainingRange, compute_training_range


def test_envelope_reach_is_spacing_of_training_loads(box):
    patch = open_patch(box)
    points = [[0.0, 0.0, 0.0], [3e-3, 0.0, 0.0], [3e-3, 4e-3, 0.0]]
    training = push(points, [[0.0, 0.0, -0.1], [0.0, 0.0, -0.2], [0.0, 0.0, -0.15]], [5e-3, 6e-3, 5e-3]).get(Pushed)
    held = push([[13e-3, 0.0, 0.0], [0.0, 4e-3, 0.0]], [[0.3, 0.0, -0.9], [0.0, 0.0, -0.9]], [9e-3, 9e-3]).get(Pushed)
    found = compute_training_range(patch, training)
    assert found.reach == pytest.approx(4e-3) and np.allclose(found.points, training.point)
    alone = Pushed(training.point[:1], training.force[:1], training.footprint[:1])
    assert compute_training_range(patch, alone).reach == 0.0
    overhang = training.footprint - patch.compute_edge_distance(training.point)
    assert found.overhang == pytest.approx(overhang.max()) and found.angle == pytest.approx(0.0, abs=1e-7)
    assert (found.force, found.footprint) == ((0.1, 0.2), (5e-3, 6e-3))
    assert found.line_force == pytest.approx(0.2 / 6e-3)
    assert not found.is_inside(patch, held).any() and found.is_inside(patch, training).all()


@pytest.mark.parametrize(
    ("force", "angle", "overhang", "radius", "away", "beyond", "excess"),
    [
        (0.2, 0.3, 1e-3, 6e-3, 0.0, 0.0, 0.0),
        (0.2, 0.7, 1e-3, 6e-3, 0.0, 0.2, 0.2),
        (0.2, 0.3, 3e-3, 6e-3, 0.0, 1.0, 1.0),
        (0.6, 0.3, 1e-3, 8e-3, 0.0, 1.0, 1.0),
        (0.28, 0.3, 1e-3, 4e-3, 0.0, 0.4, 0.4),
        (0.05, 0.3, 1e-3, 2e-3, 0.0, 1.0, 1.0),
        (0.2, 0.3, 1e-3, 12e-3, 0.0, 0.5, 0.5),
        (0.2, 0.3, 1e-3, 6e-3, 3e-3, 0.0, 2.0),
    ],
)
def test_envelope_measures_distance_outside_training_range(force, angle, overhang, radius, away, beyond, excess):
    envelope = TrainingRange(np.zeros((1, 3)), 1e-3, 2e-3, 0.5, (0.1, 0.3), (4e-3, 8e-3), 50.0)
    pushed = Pushed(np.array([[away, 0.0, 0.0]]), np.array([[0.0, 0.0, force]]), np.array([radius]))
    found = envelope.compute_excess(pushed, LoadMeasures(*(np.array([each]) for each in (force, angle, overhang))))
    assert np.concatenate(found) == pytest.approx([away, beyond, excess], abs=1e-2)
