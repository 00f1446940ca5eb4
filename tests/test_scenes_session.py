"""Live link with other programs: examples of the C++ library, pyigtl and camera images."""

import asyncio
import shutil
import socket
import subprocess
import time
import warnings
from contextlib import asynccontextmanager
from pathlib import Path

import numpy as np
import pytest
from films import FILM
from links import HOST, NAMES, in_mm, linked, peers, played

from ar.overlay.outlines import average_colour, compute_silhouette, find_colour, measure_outline_distance
from ar.tracking.image_sequences import read_video
from scenes.link.frame import to_stamp
from scenes.link.messages import encode_image, encode_transform, read_image
from scenes.link.received_transforms import TransformNames
from scenes.link.session import OverlayCamera
from scenes.play.stage import TUMOUR_COLOUR
from scenes.tracked.overlay_painter import Painter

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import pyigtl

EXAMPLES = Path("/usr/share/doc/openigtlink-examples/examples")
ROW = 10


@pytest.fixture(scope="module")
def beside(beside):
    """T_reference_cube (4, 4) [mm] of one of the film's poses."""
    return beside[ROW]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A function that compiles an example of the C++ library."""
    if not (EXAMPLES.is_dir() and Path("/usr/include/openigtlink").is_dir() and shutil.which("g++")):
        pytest.skip("Debian's libopenigtlink-dev, openigtlink-examples and g++ are not installed")
    folder = tmp_path_factory.mktemp("igtl")

    def compiled(name):
        out = folder / Path(name).stem
        flags = ["-fpermissive", "-w", "-DOpenIGTLink_PROTOCOL_VERSION=2", "-I/usr/include/openigtlink"]
        subprocess.run(["g++", *flags, EXAMPLES / name, "-lOpenIGTLink", "-lpthread", "-o", out], check=True)
        return str(out)

    return compiled


@asynccontextmanager
async def program(*words):
    process = await asyncio.create_subprocess_exec(*map(str, words), stderr=asyncio.subprocess.PIPE)
    try:
        yield process.stderr
    finally:
        process.kill()
        await process.wait()


async def lines_until(stream, *wanted):
    """What a program says until it has said all of this."""
    said = ""
    async with asyncio.timeout(10.0):
        while not all(each in said for each in wanted):
            line = await stream.readline()
            assert line, said
            said += line.decode()
    return said


async def sending(peer, beside, beat=0.03):
    """Send a pose again and again, each at its time."""
    while True:
        peer.send("TRANSFORM", NAMES.tool, encode_transform(beside), to_stamp(time.time()))
        await asyncio.sleep(beat)


def test_openigtlink_library_reads_messages_of_the_link(built, follower, registration, beside):
    receiver, asker = built("Receiver/ReceiveClient.cxx"), built("PolyData/PolyDataClient.cxx")

    async def scene():
        async with linked(follower, registration) as port, peers(port) as (tracker,):
            task = asyncio.create_task(sending(tracker, beside))
            async with program(receiver, HOST, port) as said:
                words = await lines_until(
                    said, "Receiving TRANSFORM", "String: moved", "the tumour is known", "POLYDATA"
                )
                assert "CRC" not in words
            first = 1e3 * follower.motion.stage.tumour_at_rest.vertices[0]
            async with program(asker, HOST, port) as said:
                words = await lines_until(said, "point[0] = (", "cell[0] = (")
            read = words.split("point[0] = (")[1].split(")")[0].split(",")
            assert [float(each) for each in read] == pytest.approx(first, abs=1.0)
            task.cancel()

    played(scene())


def test_link_reads_messages_of_openigtlink_library(built, follower, registration):
    sender, server = built("Tracker/TrackerClient.cxx"), built("Tracker/TrackerServer.cxx")
    names = TransformNames(tool="Tracker")
    with socket.socket() as free:
        free.bind((HOST, 0))
        other = free.getsockname()[1]

    async def scene(source, words):
        link = linked(follower, registration, names=names, source=source)
        async with link as port, peers(port) as (viewer,), program(*words(port)):
            while b"no Tracker yet" in (await viewer.next("STRING", "TipToTumour"))[1]:
                pass

    played(scene(None, lambda port: (sender, HOST, port, 30)))
    played(scene((HOST, other), lambda port: (server, other, 30)))


@pytest.mark.parametrize(
    ("key", "value"),
    [("Status", "MISSING"), ("TransformStatus", "OUT_OF_VIEW"), ("StylusToTrackerTransformStatus", "")],
)
def test_link_tool_not_seen_by_tracker_is_counted(follower, registration, beside, key, value):
    names = TransformNames(tool="StylusTipToReferenceOfSpine")  # a message carries 20 bytes of it

    async def scene():
        async with linked(follower, registration, names=names) as port, peers(port) as (tracker,):
            for number, word in enumerate((value, value, "OK")):
                if word == "OK":
                    while "2 not seen by its tracker" not in (words := await tracker.said("Sulcus")):
                        pass
                    assert f"no {names.tool} yet" in words
                message = pyigtl.TransformMessage(beside, timestamp=1e9 + number, device_name=names.tool)
                message.header_version, message.metadata = 2, {"FrameNumber": "7", key: word}
                tracker.writer.write(message.pack())
            await tracker.next("TRANSFORM", "TumourToRas")

    played(scene())


def test_pyigtl_client_sends_pose_and_receives_tumour(follower, registration, beside):
    async def scene():
        async with linked(follower, registration) as port:
            client = await asyncio.to_thread(connected, port)
            stamp = time.time()
            for number in range(3):
                client.send_message(pyigtl.TransformMessage(beside, timestamp=stamp + number, device_name=NAMES.tool))
            found = await asyncio.to_thread(client.wait_for_message, "TumourToRas", timeout=5)
            assert found.timestamp == pytest.approx(stamp, abs=2.1) and found.matrix.shape == (4, 4)
            words = await asyncio.to_thread(client.wait_for_message, "TipToTumour", timeout=5)
            assert "+-" in words.string
            await asyncio.to_thread(client.stop)

    def connected(port):
        return pyigtl.OpenIGTLinkClient(HOST, port, start_now=True)

    played(scene())


def test_camera_image_is_returned_with_tumour_overlay(follower, registration, truth, beside, stage):
    picture = next(iter(read_video(FILM / "film.mp4", 30.0, with_colour=True))).colour
    camera = follower.calibration.build_camera(truth.T_camera_scan[0])
    placed = in_mm(registration.T_patient_scan @ np.linalg.inv(truth.T_camera_scan[0]))
    mask = compute_silhouette(camera, stage.tumour_at_rest.vertices, stage.tumour_at_rest.triangles)
    tool = follower.tool.build_surface(truth.T_scan_tool[0])
    rest = in_mm(registration.T_patient_scan @ truth.T_scan_tool[0] @ np.linalg.inv(follower.tool.T_cube_tool))

    async def scene():
        eye = OverlayCamera(follower.calibration, Painter(stage, follower.tool, "contour"), 1e-4)
        async with linked(follower, registration, eye) as port, peers(port) as (tracker,):
            tracker.send("IMAGE", "Camera", encode_image(picture[:100]))
            assert "another size than the camera's: 960 x 100" in await tracker.said()
            moving = asyncio.create_task(sending(tracker, rest))
            await tracker.next("TRANSFORM", "TumourToRas")
            for apart, shift, where in (
                (0.0, 0.0, "one"),
                (0.01, 0.0, "drawn"),
                (0.02, 30.0, "fast"),
                (9.0, 0.0, "late"),
            ):
                stamp = to_stamp(begun + apart)
                if where != "late":
                    moved = placed.copy()
                    moved[0, 3] += shift
                    tracker.send("TRANSFORM", NAMES.camera, encode_transform(moved), stamp)
                tracker.send("IMAGE", "Camera", encode_image(picture), stamp + (where == "fast") * to_stamp(0.005))
                header, body = await tracker.next("IMAGE", "Overlay")
                shown[where] = read_image(body)
            assert header.stamp == stamp
            moving.cancel()

    begun, shown = 1e9, {}
    played(scene())
    # Of a single pose, or of another time than the picture's, nothing is drawn; of a camera that is too fast, no green.
    assert {where: found(drawn) for where, drawn in shown.items()} == {
        "one": False, "drawn": True, "fast": False, "late": False
    }  # fmt: skip
    assert (
        measure_outline_distance(shown["drawn"], average_colour(TUMOUR_COLOUR), mask, compute_silhouette(camera, *tool))
        < 2.5
    )


def found(drawn):
    """Whether a tumour is drawn as known."""
    return np.count_nonzero(find_colour(drawn, average_colour(TUMOUR_COLOUR))) > 5
