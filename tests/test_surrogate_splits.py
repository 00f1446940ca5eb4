"""Held-out directions and discs of the cortex, and training with a given split."""

from dataclasses import replace

import numpy as np
import pytest
from test_surrogate_tool_loads import pushes

from sim.errors import InputError
from sim.loads import Pushed
from surrogate.data.cortex_patch import open_patch
from surrogate.data.dataset import read_dataset
from surrogate.data.simulate import simulate
from surrogate.data.splits import hold_out_discs, hold_out_sectors
from surrogate.data.tool_loads import draw
from surrogate.training.train import train


@pytest.fixture(scope="module")
def pushed(box):
    return draw("palpation", box, 400, 0).get(Pushed)


def test_sector_split_holds_out_whole_sectors(box, pushed):
    """The cortex of the box faces +z: azimuth and tilt are those of the axes."""
    split = hold_out_sectors(pushed, open_patch(box))
    first = np.degrees(np.arctan2(split.centres[0, 1], split.centres[0, 0]))
    azimuth = np.degrees(np.arctan2(pushed.force[:, 1], pushed.force[:, 0])) - first
    tilt = np.degrees(np.arccos(-pushed.force[:, 2] / np.linalg.norm(pushed.force, axis=1)))
    off = np.abs((azimuth + 90.0) % 180.0 - 90.0)  # from the nearer of the two opposite directions
    assert np.array_equal(split.test_mask, (off < 22.5) & (tilt > 10.0))
    assert (
        split.area_share == 0.25
        and set(split.disc_index) == {-1, 0, 1}
        and split.training_mask.sum() + split.test_mask.sum() == 400
    )
    side = pushed.force[split.test_mask] @ split.centres[0] > 0.0
    assert np.array_equal(split.disc_index[split.test_mask], np.where(side, 0, 1))
    assert (
        "2 sectors of 45 degrees" in split.summarise() and f"{split.test_mask.sum()} loads to test" in split.summarise()
    )


def test_sector_split_rejects_upright_loads(box, pushed):
    upright = replace(pushed, force=np.tile([0.0, 0.0, -0.1], (400, 1)))
    with pytest.raises(InputError, match="more directions"):
        hold_out_sectors(upright, open_patch(box))


def test_training_uses_only_loads_of_its_split(box, pretender, tmp_path):
    simulate(tmp_path / "data.h5", pretender, draw("palpation", box, 200, 0), {})
    data = read_dataset(tmp_path / "data.h5")
    split = hold_out_sectors(data.loads.get(Pushed), open_patch(box))
    order = np.flatnonzero(split.training_mask)
    fewer = replace(split, disc_index=np.where(np.isin(np.arange(200), order[50:]), -2, split.disc_index))
    trained = train(data, ["linear"], split=fewer)
    points = data.loads.get(Pushed).point
    assert np.allclose(trained.models["linear"].envelope.points, points[order[:50]])
    assert trained.split is fewer and fewer.training_mask.sum() == 50 and fewer.test_mask.sum() == split.test_mask.sum()


def test_disc_split_holds_out_whole_discs(box, patch):
    points = pushes("palpation", box, 600, 0).point
    split = hold_out_discs(points, patch)
    distance = np.linalg.norm(points[:, None] - split.centres, axis=2)
    assert split.radius == 6e-3 and len(split.centres) >= 6 and split.area_share >= 0.15
    assert np.array_equal(split.test_mask, distance.min(axis=1) <= 6e-3)  # none stays inside, none is taken outside
    assert set(split.disc_index[split.test_mask]) == set(range(len(split.centres)))
    assert 0.1 < split.test_mask.mean() <= 0.5


def test_disc_split_has_more_discs_on_wide_patch(box, patch):
    points = pushes("palpation", box, 300, 0).point
    centres = hold_out_discs(points, patch).centres
    wide = type(patch)(patch.nodes, patch.triangles, 3.0 * patch.points)
    split = hold_out_discs(3.0 * points, wide)
    assert split.area_share >= 0.15 and len(split.centres) > len(centres)


def test_disc_split_holds_out_single_positions(box, patch):
    points = pushes("seed", box, 2000, 0).point
    split = hold_out_discs(points, patch)
    assert len(split.centres) == 6 and len(np.unique(points[split.test_mask], axis=0)) == 6
    assert len(np.unique(points[~split.test_mask], axis=0)) == 5


def test_disc_split_holds_out_at_most_half_of_the_loads(patch):
    points = np.random.default_rng(0).normal(0, 5e-3, (500, 3)) * [1, 1, 0]
    split = hold_out_discs(points, patch)
    assert split.radius < 6e-3 and split.test_mask.mean() <= 0.5 and len(split.centres) >= 6


def test_disc_split_rejects_too_few_positions(patch):
    with pytest.raises(InputError, match="simulate more"):
        hold_out_discs(np.repeat(np.eye(3)[:2] * 0.01, 5, axis=0), patch)
