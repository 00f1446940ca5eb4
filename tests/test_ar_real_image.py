"""Circular field of a microscope, and enlarged images."""

import numpy as np
import pytest
from test_scenes_stage import seen
from theatres import template_theatre

from ar.rendering.real_image import add_vignette, scale_image
from scenes.script.viewpoint import Viewpoint
from sim.errors import InputError


def test_vignette_darkens_only_pixels_beyond_its_edge():
    grey = template_theatre().intensity.values
    whole, field = seen(grey), add_vignette(seen(grey), 1.0)
    row, column = np.mgrid[:240, :320]
    away = np.hypot(column - 159.5, row - 119.5)
    assert not field.colour[away > 160.0].any()
    np.testing.assert_array_equal(field.colour[away < 140.0], whole.colour[away < 140.0])
    ring = (away > 145.0) & (away < 155.0)
    assert 0 < field.colour[ring].mean() < whole.colour[ring].mean()
    np.testing.assert_array_equal(field.depth, whole.depth)
    np.testing.assert_array_equal(field.segmentation, whole.segmentation)
    with pytest.raises(InputError, match="round field"):
        Viewpoint(field=0.0)
    with pytest.raises(ValueError, match="round field"):
        add_vignette(seen(grey), float("nan"))


def test_enlarged_image_keeps_ids_and_colours():
    sharp = seen(template_theatre().intensity.values)
    large = scale_image(sharp, 640, 480)
    assert large.drawn.colour.shape == (1, 480, 640) and large.colour.dtype == np.uint8
    for name in ("depth", "segmentation"):  # no new values, and each pixel where it was
        np.testing.assert_array_equal(getattr(large, name)[::2, ::2], getattr(sharp, name))
        np.testing.assert_array_equal(getattr(large, name)[1::2, 1::2], getattr(sharp, name))
    means = large.colour.reshape(240, 2, 320, 2, 3).mean(axis=(1, 3))
    assert np.abs(means - sharp.colour).mean() < 1.0
