"""One frame on the device: the state after an interrupted start."""

from dataclasses import replace

import numpy as np
import pytest
from test_sim_frame_sequence import follower, pushed, ride, same

from sim.fem import Fem
from sim.strategy.captured_frame import CapturedFrame


@pytest.fixture(scope="module")
def fem() -> Fem:
    return follower()


def test_interrupted_frame_start_leaves_no_state(fem, monkeypatch):
    first, middle, last = ride(fem, 3)
    expected, here = fem.deform(pushed(2.1e-3), last), fem.deform(pushed(1.4e-3), middle)
    take = CapturedFrame.load_state

    def interrupted(frame, *given):
        take(frame, *given)
        raise MemoryError

    with monkeypatch.context() as patch, pytest.raises(MemoryError):
        patch.setattr(CapturedFrame, "load_state", interrupted)
        fem.deform(pushed(2.1e-3), replace(first))
    np.testing.assert_array_equal(here.displacement, last.displacement)
    assert same(fem.deform(pushed(2.1e-3), here), expected)
