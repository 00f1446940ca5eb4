"""Side and lobe of a tumour, at published locations in MNI space."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim.bodies.lobes import describe_location

PLACES = {  # MNI [mm]; not the reference points themselves
    "right frontal": ((41, -8, 52), (22, 31, 44), (50, 15, 21), (33, 53, -11)),
    "left frontal": ((-50, 20, 15), (-40, 40, 20)),
    "left parietal": ((-46, -66, 40), (-30, -56, 50)),
    "right temporal": ((40, -50, -20), (60, -10, -10), (48, 12, -30)),
    "left occipital": ((-8, -92, 0), (-24, -96, 6)),
    "midline deep": ((3, -16, 8),),
}


@pytest.mark.parametrize("scale", [0.9, 1.0, 1.1])
def test_published_locations_have_their_lobe_at_any_scale(scale):
    box = np.array([[-72.0, -106.0, -71.0], [72.0, 73.0, 82.0]])
    for named, places in PLACES.items():
        for place in places:
            nodes = 1e-3 * scale * np.array([*box, place]) + [0.01, -0.02, 0.03]
            anatomy = SimpleNamespace(mesh=SimpleNamespace(nodes=nodes), tumour_nodes=np.array([2]))
            assert describe_location(anatomy) == named, place
