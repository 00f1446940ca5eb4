"""Observed points far from vertices."""

import numpy as np
import pytest
from conftest import make_box

from sim.errors import InputError
from surrogate.locating.observation import Observation, to_evidence


def test_points_inside_large_triangles_are_on_the_cortex():
    """At centres of 40 mm triangles, and up to the limit above them; farther points are excluded."""
    body = make_box(cells=(4, 4, 2), spacing=40e-3, tumour=60e-3, depth=40e-3, opening=70e-3)
    middle = body.mesh.nodes[body.open_surface].mean(axis=1)
    for above, kept in ((0.0, len(middle)), (11e-3, len(middle)), (13e-3, len(middle) - 3)):
        rest = middle + np.where(np.arange(len(middle)) < 3, above, 0.0)[:, None] * [0.0, 0.0, 1.0]
        evidence = to_evidence(body, Observation(rest + 1e-3, rest))
        assert len(np.unique(evidence.point)) == kept
    with pytest.raises(InputError, match="half of the points lie more than 7 mm from the open cortex"):
        to_evidence(body, Observation(middle + [0.0, 0.0, 7e-3], middle + [0.0, 0.0, 7e-3]))
