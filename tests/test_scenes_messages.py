"""OpenIGTLink messages against pyigtl and the C++ library, and malformed messages."""

import struct
import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scenes.link.frame import (
    HEADER,
    BadMessageError,
    pack_message,
    read_content,
    read_header,
    read_metadata,
    to_stamp,
    to_time,
)
from scenes.link.messages import (
    EncodedMesh,
    Status,
    encode_image,
    encode_points,
    encode_polydata,
    encode_status,
    encode_string,
    encode_transform,
    read_image,
    read_points,
    read_position,
    read_transform,
)  # fmt: skip
from scenes.link.received_transforms import ReceivedTransforms, TransformNames

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import pyigtl

STAMP = to_stamp(1_700_000_000.25)
RANDOM = np.random.default_rng(0)


def matrix(shift=(10.0, -20.0, 30.0)):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.3, -0.5, 1.1]).as_matrix(), shift
    return T


def theirs(kind, name, body):
    """Our message as pyigtl reads it."""
    raw = pack_message(kind, name, body, STAMP)
    fields = pyigtl.messages.MessageBase.parse_header(raw[: HEADER.size])
    message = pyigtl.messages.MessageBase.create_message(kind)
    message.unpack(fields, raw[HEADER.size :])
    assert message.device_name == name and message.timestamp == pytest.approx(to_time(STAMP))
    assert pyigtl.messages.CRC64(raw[HEADER.size :]) == struct.unpack(">Q", raw[50:58])[0]
    return message


def ours(message, version=1, **metadata):
    """A message of pyigtl as we read it: header and content."""
    message.header_version, message.metadata = version, metadata
    raw = message.pack()
    header = read_header(raw[: HEADER.size])
    return header, read_content(header, raw[HEADER.size :])


def test_pyigtl_reads_sent_messages():
    assert theirs("TRANSFORM", "TumourToRas", encode_transform(matrix())).matrix == pytest.approx(matrix(), abs=1e-5)
    assert theirs("STRING", "TipToTumour", encode_string("12.3 +- 0.4 mm")).string == "12.3 +- 0.4 mm"
    places = RANDOM.normal(size=(3, 3))
    read = theirs("POINT", "PointsNow", encode_points(["a", "b", "c"], places))
    assert np.array(read.positions) == pytest.approx(places, abs=1e-6) and list(read.names) == ["a", "b", "c"]
    colour = RANDOM.integers(0, 255, (5, 7, 3), np.uint8)
    read = theirs("IMAGE", "Overlay", encode_image(colour))
    assert np.array_equal(read.image, colour[None]) and read.world_coordinate_system == "ras"


@pytest.mark.parametrize("version", [1, 2])
def test_pyigtl_messages_are_read(version):
    more = {} if version == 1 else {"ToolTransformStatus": "OK", "a": "b"}
    sent = pyigtl.TransformMessage(matrix(), timestamp=1_700_000_000.25, device_name="StylusTipToReference")
    header, content = ours(sent, version, **more)
    assert (header.kind, header.name, header.version) == ("TRANSFORM", "StylusTipToReference", version)
    assert to_time(header.stamp) == pytest.approx(1_700_000_000.25, abs=1e-6)
    assert read_transform(content) == pytest.approx(matrix(), abs=1e-5)
    _, content = ours(pyigtl.PointMessage(np.arange(6.0).reshape(2, 3), ["a", "b"], device_name="P"), version, **more)
    names, places = read_points(content)
    assert names == ["a", "b"] and np.array_equal(places, np.arange(6.0).reshape(2, 3))
    colour = RANDOM.integers(0, 255, (1, 5, 7, 3), np.uint8)
    _, content = ours(pyigtl.ImageMessage(colour, device_name="I"), version, **more)
    assert np.array_equal(read_image(content), colour[0])
    _, content = ours(pyigtl.ImageMessage(colour[..., :1], device_name="I"), version, **more)
    assert np.array_equal(read_image(content)[..., 2], colour[0, ..., 0])


def test_polydata_and_status_messages_have_protocol_layout():
    corners = RANDOM.normal(size=(4, 3)).astype(np.float32)
    body = encode_polydata(corners, EncodedMesh.from_triangles(np.array([[0, 1, 2], [0, 2, 3]])))
    assert struct.unpack(">10I", body[:40]) == (4, 0, 0, 0, 0, 2, 32, 0, 0, 0)
    assert np.array_equal(np.frombuffer(body, ">f4", 12, 40).reshape(4, 3), corners)
    assert struct.unpack(">8I", body[88:]) == (3, 0, 1, 2, 3, 0, 2, 3)
    body = encode_status(Status.NOT_READY, "no pose yet")
    assert struct.unpack(">Hq20s", body[:30])[0] == 13 and body[30:] == b"no pose yet\0"


def test_position_message_has_translation_and_quaternion():
    """Layout of `igtl_position.h`; pyigtl writes the layout of points instead."""
    numbers = [*matrix()[:3, 3], *Rotation.from_matrix(matrix()[:3, :3]).as_quat()]
    assert read_position(struct.pack(">7f", *numbers)) == pytest.approx(matrix(), abs=1e-5)
    with pytest.raises(BadMessageError, match="wrong size: 12 bytes"):
        read_position(bytes(12))


def test_time_stamp_round_trips_exactly():
    raw = pack_message("TRANSFORM", "A", encode_transform(np.eye(4)), STAMP + 1)
    assert read_header(raw[:58]).stamp == STAMP + 1


def test_message_checksum_matches_published_crc64():
    assert read_header(pack_message("STRING", "A", b"123456789", 0)[:58]).checksum == 0x6C40DF5F0B497347


def messaged(value, value_size=None, count=1):
    """Header and body of a message of version 2 with one pair of metadata."""
    index = struct.pack(">HHHI", count, 3, 3, len(value) if value_size is None else value_size)
    body = struct.pack(">HHII", 12, len(index), 3 + len(value), 0) + b"content" + index + b"key" + value.encode()
    raw = b"\0\2" + pack_message("STRING", "A", body, 0)[2:]
    return read_header(raw[: HEADER.size]), body


def test_metadata_follows_the_message_content():
    header, body = messaged("OK\0")
    assert read_content(header, body) == b"content" and read_metadata(header, body) == {"key": "OK"}
    assert read_metadata(*messaged("", count=1)) == {"key": ""}
    assert read_metadata(read_header(pack_message("STRING", "A", b"", 0)[:58]), b"") == {}


def body_of(raw):
    return read_content(read_header(raw[:58]), raw[58:])


@pytest.mark.parametrize(
    ("read", "why"),
    [
        (lambda: read_header(b"GET / HTTP/1.1\r\n".ljust(58)), "no OpenIGTLink"),
        (lambda: read_header(bytes(58)), "no OpenIGTLink"),
        (lambda: body_of(pack_message("STRING", "A", b"abc", 0)[:-1] + b"d"), "wrong checksum"),
        (lambda: body_of(b"\0\2" + pack_message("STRING", "A", b"abc", 0)[2:]), "too short for an extended"),
        (lambda: body_of(b"\0\2" + pack_message("STRING", "A", b"\0\xff" + bytes(14), 0)[2:]), "extended header names"),
        (lambda: read_metadata(*messaged("a", value_size=9)), "other sizes than its index"),
        (lambda: read_metadata(*messaged("a", count=2)), "other sizes than its index"),
        (lambda: read_transform(bytes(44)), "wrong size: 44 bytes in place of 48"),
        (lambda: read_position(bytes(28)), "quaternion"),
        (lambda: read_points(bytes(135)), "wrong size"),
        (lambda: read_points(encode_points(["a"], np.array([[0.0, np.nan, 0.0]]))), "not finite"),
        (lambda: read_image(bytes(20)), "too short"),
        (lambda: read_image(encode_image(np.zeros((4, 4, 3), np.uint8))[:-1]), "another number of pixels"),
        (lambda: read_image(encode_image(np.zeros((4, 4, 2), np.uint8))), "not one complete 8-bit image"),
    ],
)  # fmt: skip
def test_malformed_message_is_rejected(read, why):
    with pytest.raises(BadMessageError, match=why):
        read()


def test_pose_is_known_while_its_transforms_are_recent():
    names = TransformNames()
    heard = ReceivedTransforms(names, 0.3)
    assert heard.find_relative_transform(names.tool, 0.0) == "no StylusTipToReference yet"
    heard = heard.add_transform(names.tool, matrix(), STAMP, 1.0, 0)
    found = heard.find_relative_transform(names.tool, 1.2)
    assert found.stamp == STAMP and found.T[:3, 3] == pytest.approx([0.01, -0.02, 0.03])
    assert heard.find_relative_transform(names.tool, 1.4) == "no new StylusTipToReference for 0.4 s"
    for T, stamp, sender, why in (
        (np.eye(4), STAMP + 9, 0, "identity"),
        (np.diag([0.0, 0.0, 0.0, 1.0]), STAMP + 9, 0, "zeros, which trackers send"),
        (matrix(), STAMP, 0, "the same time stamp"),
        (matrix(), STAMP - 9, 0, "before the last"),
        (matrix(), STAMP + 9, 1, "another client"),
    ):
        with pytest.raises(BadMessageError, match=why):
            heard.add_transform(names.tool, T, stamp, 1.1, sender)
    assert (
        heard.add_transform(names.tool, matrix(), STAMP, 2.0, 1).newest[names.tool].sender == 1
    )  # the first one is silent
    clock_set = heard.add_transform(names.tool, matrix(), to_stamp(to_time(STAMP) - 60.0), 1.1, 0)
    assert clock_set.newest[names.tool].arrived == 1.1
