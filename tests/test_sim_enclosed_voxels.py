"""Voxels enclosed by a surface."""

import numpy as np
import pytest
from test_sim_healthy_heads import BALL_ML, RADII, egg

from sim.bodies.enclosed_voxels import rasterise_interior
from sim.errors import InputError


def test_enclosed_voxels_match_volume_of_closed_surface():
    points, triangles = egg()
    mask, affine = rasterise_interior(points, triangles, 2e-3)
    middles = np.argwhere(np.ones_like(mask)) @ affine[:3, :3].T + affine[:3, 3]
    outside = np.linalg.norm(middles / RADII, axis=1).reshape(mask.shape) > 1.0
    assert mask.sum() * 8e-3 == pytest.approx(BALL_ML, rel=0.01)
    assert not (mask & outside).any()  # flat triangles between points of the ellipsoid lie inside
    with pytest.raises(InputError, match="not closed"):
        rasterise_interior(points, triangles[1:], 2e-3)
