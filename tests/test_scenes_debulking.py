"""Debulking of a tumour: its corridor, and rejected numbers of steps."""

import numpy as np
import pytest
from test_scenes_resection import SURGERY

from scenes.script.debulking import Debulking
from sim.anatomy import TUMOUR_LABEL
from sim.errors import InputError


@pytest.mark.parametrize(("asked", "wide"), [(1e-4, 6e-3), (9e-3, 9e-3)])
def test_corridor_reaches_from_cortex_to_tumour(box, asked, wide):
    """Width as requested, but at least one mesh edge, which is 6 mm here."""
    corridor = np.array(Debulking(SURGERY.times, corridor=asked).build_resection(box).steps[0])
    middle = box.mesh.nodes[box.mesh.tets].mean(axis=1)
    brain, across = box.mesh.region != TUMOUR_LABEL, np.linalg.norm(middle[:, :2], axis=1)
    above = middle[:, 2] > middle[~brain, 2].mean() + 1e-3
    inner, outer = (np.flatnonzero(brain & above & (across < share * wide)) for share in (0.95, 1.05))
    assert len(inner) > 10 and np.isin(inner, corridor).all()
    assert np.isin(corridor, np.flatnonzero(brain & (across < 1.05 * wide))).all() and len(corridor) < 1.2 * len(outer)


def test_debulking_with_more_steps_than_elements_is_rejected(box):
    with pytest.raises(InputError, match="mesh finer"):
        Debulking(times=tuple(np.arange(5000.0))).build_resection(box)
