"""Surfaces of layers on a device."""

from dataclasses import replace

import numpy as np
from test_ar_renderer import LAMP, ball, camera, striped

from ar.rendering.layer import Solid
from ar.rendering.renderer import render


def test_two_solid_textures_render_independently():
    other = replace(ball(), solid=Solid(np.eye(4)[:, None].repeat(3, 1), 50.0 * np.eye(4)), rest=ball().vertices)
    both = render(camera(), [striped(), other], LAMP)
    for layer in (striped(), other):
        alone = render(camera(), [layer], LAMP)
        here = both.segmentation == layer.id
        assert here.sum() > 500 and np.array_equal(both.colour[here], alone.colour[here])
