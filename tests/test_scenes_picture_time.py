"""Where the link takes a camera to be when a picture was taken; and addresses of servers that it hears."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scenes.commands.link import parse_address
from scenes.link.console import format_address
from scenes.link.frame import to_stamp
from scenes.link.pose_responder import place_camera
from scenes.link.received_transforms import ReceivedTransforms, TransformNames
from sim.errors import InputError

BEGUN, STEP = 1e9, 1.0 / 30.0
TUMOUR = np.array([0.02, -0.01, 0.4])
"""From the camera [m]."""


def camera(time):
    """A hand that sways by 20 mm and 4 degrees, once in 1.5 s: T (4, 4) [mm]."""
    T = np.eye(4)
    sway = np.sin(2.0 * np.pi * time / 1.5)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.0, 0.07 * sway, 0.0]).as_matrix(), [20.0 * sway, 0.0, 300.0]
    return T


def heard_of(times, stamped=True, sender=0):
    """A camera's transforms as they came, each 5 ms after its time."""
    names = TransformNames()
    heard = ReceivedTransforms(names, 0.3)
    for time in times:
        stamp = to_stamp(BEGUN + time) if stamped else 0
        heard = heard.add_transform(names.camera, camera(time), stamp, time + 5e-3, sender)
    return heard


def off(placed, time):
    """How far the tumour is from where it is in the picture of a time [m]."""
    truth = camera(time)
    truth[:3, 3] *= 1e-3
    return np.linalg.norm(placed.T[:3, :3] @ TUMOUR + placed.T[:3, 3] - truth[:3, :3] @ TUMOUR - truth[:3, 3])


def at(heard, time, now=None, stamped=True):
    middle = camera(0.0)[:3, :3] @ TUMOUR + 1e-3 * camera(0.0)[:3, 3]
    stamp = to_stamp(BEGUN + time) if stamped else 0
    return place_camera(
        heard.list_transforms(heard.names.camera), time if now is None else now, stamp, middle, heard.stale
    )


def test_interpolated_pose_reports_remaining_error():
    times = STEP * np.arange(40)
    heard = heard_of(times)
    for late, share in ((2, 0.5), (5, 0.3), (12, 0.9), (1, 0.6)):  # poses that came after the picture's
        time = times[-1 - late] + (share - 1.0) * STEP
        placed = at(heard, time)
        newest = replace(placed, T=heard.list_transforms(heard.names.camera)[-1].T)
        assert off(placed, time) <= placed.moved < 0.2e-3 and off(placed, time) < 0.1 * off(newest, time)
    ahead = at(heard, times[-1] + 0.03)
    assert off(ahead, times[-1] + 0.03) <= ahead.moved < 4e-3


def test_newest_pose_counts_with_camera_travel():
    times = STEP * np.arange(12)
    middle = camera(0.0) @ [*1e3 * TUMOUR, 1.0]
    here, there = (np.linalg.inv(camera(time)) @ middle for time in times[-2:])
    way = 1e-3 * np.linalg.norm(here - there)
    for heard, time, stamped, apart in (
        (heard_of(times), times[-1] + 0.2, True, 0.2),
        (heard_of(times[-2:]), times[-1] - 0.5 * STEP, True, 0.5 * STEP),
        (heard_of(times, stamped=False), times[-1] + 0.02, False, 0.02 - 5e-3),
    ):
        placed = at(heard, time, stamped=stamped)
        assert np.allclose(placed.T[:3, :3], camera(times[-1])[:3, :3])
        assert placed.moved == pytest.approx(way * apart / STEP, rel=1e-4)
    assert at(heard_of(times), times[-1] + 1.0) == "no {name} within 0.3 s of the image's time"
    assert "alone" in at(heard_of(times[-1:]), times[-1])


def test_poses_of_other_client_or_time_are_not_neighbours():
    heard = heard_of(STEP * np.arange(9))
    name = heard.names.camera
    taken_over = heard.add_transform(name, camera(0.4), to_stamp(BEGUN + 0.4), 1.0, 1)
    assert len(heard.list_transforms(name)) == 9 and len(taken_over.list_transforms(name)) == 1
    set_back = heard.add_transform(name, camera(0.4), to_stamp(BEGUN - 60.0), 0.4, 0)
    assert [sent.stamp for sent in set_back.list_transforms(name)] == [to_stamp(BEGUN - 60.0)]
    assert len(heard_of(STEP * np.arange(200)).list_transforms(name)) == 33


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("localhost", ("localhost", 18944)),
        ("plus.example:18945", ("plus.example", 18945)),
        ("192.0.2.7:", ("192.0.2.7", 18944)),
        ("[::1]:18945", ("::1", 18945)),
        ("[fe80::1%eth0]", ("fe80::1%eth0", 18944)),
        ("::1", ("::1", 18944)),
    ],
)
def test_an_address_is_a_host_or_one_of_ipv6_in_brackets(text, address):
    assert parse_address(text) == address
    assert parse_address(format_address(*address)) == address


@pytest.mark.parametrize("text", ["", ":18944", "[::1", "[localhost]:3", "::1:99999", "host:65536", "host:x", "a:b:1"])
def test_an_address_that_is_none_is_refused(text):
    with pytest.raises(InputError, match="in brackets"):
        parse_address(text)
