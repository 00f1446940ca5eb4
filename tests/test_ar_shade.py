"""Shadow of a lamp at a point."""

import numpy as np
import pytest

from ar.optics.camera import look_at
from ar.rendering.layer import Layer
from ar.rendering.renderer import Lamp, render, to_light

PLAIN, LID = 1, 2


def square(half: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    """A level square (4, 3) [m] round the z axis, which faces up."""
    corners = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return np.column_stack([corners, np.full(4, height)]), np.array([[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(("more", "dark"), [(-5e-4, False), (1e-4, False), (4e-4, True), (2e-3, True)])
def test_shadow_requires_distance_above_the_bias(more, dark):
    """Side view below a small lid whose height above the floor is near the bias of the shadow map."""
    camera = look_at(np.array([0.3, 0.0, 0.03]), np.zeros(3), np.array([0.0, 0.0, 1.0]), np.radians(8.0), 320, 200)
    lamp = Lamp(np.array([0.0, 0.0, 1.0]), np.zeros(3), 0.06)
    floor = Layer("floor", PLAIN, *square(0.05, 0.0), colour=(0.8, 0.8, 0.8))
    lid = Layer("lid", LID, *square(0.012, to_light(lamp).offset + more), colour=(0.8, 0.8, 0.8), casts_shadow=True)
    picture = render(camera, [floor, lid], lamp)
    column, row = np.rint(camera.project(np.array([0.008, 0.0, 0.0]))[0]).astype(int)
    beside = np.rint(camera.project(np.array([0.03, 0.0, 0.0]))[0]).astype(int)[1]
    assert picture.segmentation[row, column] == picture.segmentation[beside, column] == PLAIN
    under, open_to_it = picture.colour[[row, beside], column].astype(int).sum(axis=1)
    assert (under < 0.7 * open_to_it) == dark
