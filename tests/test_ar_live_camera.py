"""Live cameras that are unplugged or send no image."""

import time
from itertools import islice

import pytest
from films import Plugged

from ar.tracking.live_camera import read_camera_images, read_newest_images


def test_unplugged_camera_is_reopened_until_it_returns():
    cameras, moments, late = [Plugged(2), Plugged(0), Plugged(1)], iter(range(9)), []
    first = cameras.pop(0)

    def again():
        late.append(cameras.pop(0))
        return late[-1]

    found = read_camera_images(first, "camera 0", again, lambda: next(moments))
    seen = [next(found) for _ in range(2)]
    assert [each.time for each in seen] == [0, 1] and seen[0].colour.shape == (720, 960, 3)
    seen = list(islice(found, 21))
    assert first.released and seen[:20] == [None] * 20 and seen[20].time == 2 and late[0].released
    found.close()
    assert late[1].released


def test_latest_image_is_returned_and_timeout_yields_none():
    def slow():
        yield from "abc"
        time.sleep(0.15)
        yield "d"
        raise ValueError("unplugged")

    found = read_newest_images(slow(), 0.05)
    time.sleep(0.02)
    assert next(found) == "c"  # a and b are lost
    assert next(found) is None
    with pytest.raises(ValueError, match="unplugged"):
        for each in found:
            assert each in ("d", None)
