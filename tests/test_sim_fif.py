"""Head surfaces in FIF."""

from importlib.util import find_spec
from pathlib import Path

import pytest

from sim.bodies.enclosed_voxels import fill_enclosed
from sim.bodies.fif import read_surface
from sim.bodies.healthy_heads import INNER_SKULL


@pytest.mark.skipif(find_spec("mne") is None, reason="the package mne is not installed: pip install -e '.[heads]'")
def test_the_skull_that_mne_ships_is_of_a_head():
    points, triangles = read_surface(Path(find_spec("mne").origin).parent / INNER_SKULL)
    mask, _ = fill_enclosed(points, triangles, 2e-3)
    assert mask.sum() * 8e-3 == pytest.approx(2190, abs=10)
