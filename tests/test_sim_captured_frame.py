"""One frame on the device: what is left when it cannot be taken."""

from dataclasses import replace

import numpy as np
import pytest
from test_sim_frame_sequence import follower, pushed, ride, same

from sim.fem import Fem
from sim.strategy.captured_frame import CapturedFrame


@pytest.fixture(scope="module")
def fem() -> Fem:
    return follower()


def test_a_start_that_cannot_be_taken_leaves_no_state_behind(fem, monkeypatch):
    first, middle, last = ride(fem, 3)
    expected, here = fem.deform(pushed(2.1e-3), last), fem.deform(pushed(1.4e-3), middle)
    take = CapturedFrame.take

    def interrupted(frame, *given):
        take(frame, *given)
        raise MemoryError

    with monkeypatch.context() as patch, pytest.raises(MemoryError):
        patch.setattr(CapturedFrame, "take", interrupted)
        fem.deform(pushed(2.1e-3), replace(first))
    np.testing.assert_array_equal(here.displacement, last.displacement)
    assert same(fem.deform(pushed(2.1e-3), here), expected)
