"""Directions left out: whole sectors, by the force's direction alone; and training on a split of one's own."""

from dataclasses import replace

import numpy as np
import pytest

from sim.errors import InputError
from sim.loads import Pushed
from surrogate.data.cortex_patch import open_patch
from surrogate.data.dataset import read_dataset
from surrogate.data.direction_split import leave_sectors_out
from surrogate.data.simulate import simulate
from surrogate.data.tool_loads import draw
from surrogate.training.train import train


@pytest.fixture(scope="module")
def pushed(box):
    return draw("palpation", box, 400, 0).of(Pushed)


def test_whole_sectors_are_left_out(box, pushed):
    """The box's cortex looks up: azimuths in the plane and angles from the normal are those of the axes."""
    split = leave_sectors_out(pushed, open_patch(box))
    first = np.degrees(np.arctan2(split.centres[0, 1], split.centres[0, 0]))
    azimuth = np.degrees(np.arctan2(pushed.force[:, 1], pushed.force[:, 0])) - first
    tilt = np.degrees(np.arccos(-pushed.force[:, 2] / np.linalg.norm(pushed.force, axis=1)))
    off = np.abs((azimuth + 90.0) % 180.0 - 90.0)  # from the nearer of the two opposite directions
    assert np.array_equal(split.test, (off < 22.5) & (tilt > 10.0))
    assert split.share == 0.25 and set(split.disc) == {-1, 0, 1} and split.train.sum() + split.test.sum() == 400
    side = pushed.force[split.test] @ split.centres[0] > 0.0
    assert np.array_equal(split.disc[split.test], np.where(side, 0, 1))
    assert "2 sectors of 45 degrees" in split.summary() and f"{split.test.sum()} loads to test" in split.summary()


def test_upright_loads_cannot_be_split(box, pushed):
    upright = replace(pushed, force=np.tile([0.0, 0.0, -0.1], (400, 1)))
    with pytest.raises(InputError, match="more directions"):
        leave_sectors_out(upright, open_patch(box))


def test_training_sees_what_its_split_allows(box, pretender, tmp_path):
    simulate(tmp_path / "data.h5", pretender, draw("palpation", box, 200, 0), {})
    data = read_dataset(tmp_path / "data.h5")
    split = leave_sectors_out(data.loads.of(Pushed), open_patch(box))
    order = np.flatnonzero(split.train)
    fewer = replace(split, disc=np.where(np.isin(np.arange(200), order[50:]), -2, split.disc))
    trained = train(data, ["linear"], split=fewer)
    points = data.loads.of(Pushed).point
    assert np.allclose(trained.models["linear"].envelope.points, points[order[:50]])
    assert trained.split is fewer and fewer.train.sum() == 50 and fewer.test.sum() == split.test.sum()
