"""The round field of a microscope."""

import numpy as np
import pytest
from test_scenes_stage import seen
from theatres import template_theatre

from ar.rendering.real_image import add_vignette
from scenes.script.viewpoint import Viewpoint
from sim.errors import InputError


def test_round_field_darkens_only_beyond_its_edge():
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
