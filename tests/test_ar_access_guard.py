"""Access control of the page's server: requests, tokens and messages, on this machine only."""

import http.client
import math
import socket
import threading
import time
from contextlib import closing, nullcontext
from urllib.parse import urlsplit

import msgspec
import numpy as np
import pytest
import viser
from visitor import Visitor, free_port, wait_for
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from ar.page import access_guard
from ar.page.browser import Browser
from ar.page.messages import MessageError, check_message
from ar.page.parts import Dropdown, Playback, SceneViewpoint, Slider, Toggle

PROTOCOL = [f"viser-v{viser.__version__}"]


class Page(Browser):
    """A page that notes what it is sent."""

    def __init__(self, host="127.0.0.1", port=None, origins=(), **limits):
        self.heard = []
        super().__init__(
            [],
            SceneViewpoint(np.array([0.0, -0.3, 0.2]), np.zeros(3), np.array([0.0, 0.0, 1.0])),
            Playback(100, self.heard.append, self.heard.append),
            [
                Dropdown("deformer", ("FEM", "ANN"), "ANN", self.heard.append),
                Slider("force [N]", 0.0, 0.4, 0.01, 0.2, self.heard.append),
                Toggle("gravity", True, self.heard.append),
            ],
            host=host,
            port=free_port() if port is None else port,
            size=(64, 48),
            limits=access_guard.ConnectionLimits(**limits),
            origins=origins,
        )

    @property
    def port(self):
        return self.server.get_port()


@pytest.fixture(scope="module")
def shared(request):
    page = Page(**getattr(request, "param", {}))
    yield page
    page.close()


@pytest.fixture
def page(shared):
    shared.heard.clear()
    return shared


@pytest.fixture
def visitor(page):
    visitor = Visitor(page, 1200)
    assert wait_for(lambda: page.visitors == 1)
    yield visitor
    visitor.wire.close()
    assert wait_for(lambda: page.visitors == 0)


def still_heard(page, visitor):
    """True if a visitor's next message arrives and none before it did; messages are handled in order."""
    value = 0.1 if page.inputs["force [N]"].value != 0.1 else 0.2
    visitor.set(page.inputs["force [N]"], value)
    return wait_for(lambda: value in page.heard) and page.heard == [value]


def ask(page, path="/", method="GET", **headers):
    """Status and headers of an HTTP response."""
    wire = http.client.HTTPConnection("127.0.0.1", page.port, timeout=10)
    wire.request(method, path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    answer = wire.getresponse()
    answer.read()
    wire.close()
    return answer.status, answer.headers


def knock(page, path="", **settings):
    """Status of a web-socket handshake; 101 if it is accepted."""
    try:
        connect(f"ws://127.0.0.1:{page.port}{path}", subprotocols=PROTOCOL, **settings).close()
    except InvalidStatus as error:
        return error.response.status_code
    return 101


class TestSharing:
    def test_visitor_cannot_open_a_share_tunnel(self, page, visitor, monkeypatch, capfd):
        opened = []
        monkeypatch.setattr("viser._viser.ViserTunnel", lambda *words: opened.append(words))
        monkeypatch.setattr(page.server, "request_share_url", lambda *words: opened.append(words))
        for kind in ("ShareUrlRequest", "ShareUrlDisconnect"):
            visitor.wire.send(msgspec.msgpack.encode({"type": kind}))
        assert still_heard(page, visitor)
        time.sleep(0.2)
        assert not opened
        assert "Traceback" not in capfd.readouterr().err

    def test_server_has_no_handler_for_share_requests(self, page):
        kinds = {kind.__name__ for kind in page.server._websock_server._incoming_handlers}
        assert "GuiUpdateMessage" in kinds and not [kind for kind in kinds if "Share" in kind]


class TestDoor:
    @pytest.mark.parametrize(
        "origin",
        [
            "http://evil.example",
            "null",
            "https://127.0.0.1:{port}",
            "http://127.0.0.1:1",
            "http://127.0.0.1:{port}0",  # a page on another port of this machine
            "http://127.0.0.1:{port}.evil.example",
        ],
    )
    def test_foreign_origin_is_rejected_with_403(self, page, origin):
        assert knock(page, origin=origin.format(port=page.port)) == 403
        assert ask(page, Origin=origin.format(port=page.port))[0] == 403

    @pytest.mark.parametrize(
        "host",
        ["evil.example:{port}", "127.0.0.1:1", "127.0.0.1", "localhost.evil.example:{port}", "localhost:{port}0"],
    )
    def test_foreign_host_header_is_rejected_with_403(self, page, host):
        host = host.format(port=page.port)
        assert ask(page, Host=host)[0] == 403
        with socket.create_connection(("127.0.0.1", page.port), timeout=10) as wire:
            shake = f"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Protocol: {PROTOCOL[0]}\r\n"
            keys = "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
            wire.sendall(f"GET / HTTP/1.1\r\nHost: {host}\r\n{shake}{keys}\r\n".encode())
            assert b" 403 " in wire.recv(4096).split(b"\r\n")[0]

    def test_second_origin_header_is_rejected_with_403(self, page):
        with socket.create_connection(("127.0.0.1", page.port), timeout=10) as wire:
            own = f"Host: localhost:{page.port}\r\nOrigin: http://localhost:{page.port}\r\n"
            wire.sendall(f"GET / HTTP/1.1\r\n{own}Origin: http://evil.example\r\n\r\n".encode())
            assert b" 403 " in wire.recv(4096).split(b"\r\n")[0]

    @pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "LOCALHOST", "[::1]"])
    def test_requests_from_the_page_origin_are_accepted(self, page, name):
        place = f"{name}:{page.port}"
        assert ask(page, Host=place)[0] == 200
        assert knock(page, origin=f"http://{place}") == 101

    def test_page_forbids_embedding_in_foreign_frames(self, page):
        assert "frame-ancestors 'self'" in ask(page)[1]["Content-Security-Policy"]

    def test_connection_above_visitor_limit_is_rejected_with_503(self):
        with (
            closing(Page(max_clients=1)) as page,
            connect(f"ws://127.0.0.1:{page.port}", subprotocols=PROTOCOL, max_size=None),
        ):
            assert knock(page) == 503

    def test_malformed_http_requests_print_no_output(self, page, capfd):
        assert ask(page, method="HEAD")[0] == 405
        for text in (
            b"\x16\x03\x01\x02\x00",
            b"GET / HTTP/1.0\r\n\r\n",
            b"GET /" + b"a" * 9000,
            b"nonsense\r\n\r\n",
            b"",
        ):
            with socket.create_connection(("127.0.0.1", page.port), timeout=10) as wire:
                wire.sendall(text)
                wire.shutdown(socket.SHUT_WR)
                wire.recv(4096)
        assert ask(page, "/" + "a" * 5000)[0] == 404 and ask(page, "/%00")[0] == 404
        with pytest.raises(InvalidStatus):
            connect(f"ws://127.0.0.1:{page.port}", subprotocols=["viser-v0.0.0"])
        assert ask(page)[0] == 200
        assert capfd.readouterr() == ("", "")

    def test_unsupported_viser_version_raises_unguarded_error(self, monkeypatch):
        before = set(threading.enumerate())
        with monkeypatch.context() as patch:
            patch.setattr(viser, "__version__", "2.0.0")
            with pytest.raises(access_guard.ViserError, match=r"viser 2\.0\.0 cannot be guarded: install viser"):
                Page()
        monkeypatch.setattr(access_guard, "guard_server", lambda *words: nullcontext([]))
        with pytest.raises(access_guard.ViserError, match="cannot be guarded"):
            Page()
        assert wait_for(lambda: set(threading.enumerate()) <= before)


@pytest.fixture(scope="module")
def far():
    """Page on a network address, requested here from this machine."""
    page = Page("0.0.0.0")
    yield page
    page.close()


class TestToken:
    def test_loopback_page_has_no_token(self, page):
        assert (
            page.token is None
            and access_guard.AccessPolicy.create("localhost").token is None
            and access_guard.AccessPolicy.create("127.0.0.2").token is None
        )

    def test_host_with_network_address_has_a_token(self, monkeypatch):
        found = [(0, 0, 0, "", (address, 0)) for address in ("127.0.0.1", "192.0.2.1")]
        monkeypatch.setattr(socket, "getaddrinfo", lambda *words: found)
        assert access_guard.AccessPolicy.create("both.example").token is not None

    def test_requests_without_valid_token_are_rejected_with_403(self, far):
        token = far.token
        assert len(token) >= 32 and far.address == f"http://localhost:{far.port}/?token={token}"
        assert access_guard.AccessPolicy.create("0.0.0.0").token != token
        for path in ("/", "/?token=", f"/?token={token[:-1]}", "/?token=%C3%A9", f"/?other={token}"):
            assert ask(far, path)[0] == 403, path
            assert knock(far, path) == 403, path
        assert ask(far, Cookie=f"page-{far.port}=wrong")[0] == 403
        assert ask(far, f"/?token={token}", Host="evil.example")[0] == 403

    def test_page_requires_token_and_web_socket_requires_cookie(self, far):
        status, headers = ask(far, urlsplit(far.address).path + "?" + urlsplit(far.address).query)
        assert status == 200 and "HttpOnly" in headers["Set-Cookie"] and "SameSite=Strict" in headers["Set-Cookie"]
        cookie = headers["Set-Cookie"].split(";")[0]
        assert knock(far, additional_headers={"Cookie": f"other=1; {cookie}"}) == 101
        visitor = Visitor(far, 1200)
        assert wait_for(lambda: far.visitors == 1)
        visitor.wire.close()


BAD = {
    "force [N]": [math.nan, math.inf, -math.inf, 1e9, -0.01, "0.2", "nan", True, None, [0.2], {"a": 1}, 2**63],
    "deformer": ["../x", "", 0, None, ["FEM"], True],
    "gravity": ["", 0, 2, None, []],
    "frame": [10**6, -1, 1.5, 100, math.nan, "7", False, None, 2**64 - 1],
}


class TestMessages:
    @pytest.mark.parametrize("label", BAD)
    def test_value_out_of_range_does_not_change_the_control(self, page, visitor, label, capfd):
        control = page.frame if label == "frame" else page.inputs[label]
        before = control.value
        for value in BAD[label]:
            visitor.set(control, value)
        assert still_heard(page, visitor)
        assert label == "force [N]" or control.value == before
        said = capfd.readouterr().err
        assert "Traceback" not in said and len(said.splitlines()) <= 2

    def test_values_at_range_limits_are_accepted(self, page, visitor):
        for value in (0, 0.4, 0.4 + 1e-12):
            visitor.set(page.inputs["force [N]"], value)
        visitor.set(page.frame, 99)
        visitor.set(page.frame, 7.0)
        visitor.set(page.inputs["deformer"], "FEM")
        visitor.set(page.inputs["gravity"], False)
        assert wait_for(lambda: len(page.heard) == 6)
        assert page.heard == [0.0, 0.4, 99, 7, "FEM", False] and isinstance(page.heard[3], int)
        visitor.set(page.inputs["deformer"], "ANN")
        visitor.set(page.inputs["gravity"], True)
        assert wait_for(lambda: len(page.heard) == 8)

    def test_update_of_other_control_attributes_is_ignored(self, page, visitor):
        control = page.inputs["force [N]"]
        uuid = control._impl.uuid
        for name, value in {"removed": True, "update_cb": [], "sync_cb": None, "nothing": 1, "is_button": True}.items():
            for updates in ({name: value}, {"value": 0.3, name: value}):
                say(visitor, type="GuiUpdateMessage", uuid=uuid, updates=updates)
        say(visitor, type="GuiUpdateMessage", uuid=uuid, updates={})
        say(visitor, type="GuiUpdateMessage", uuid="none such", updates={"value": 1.0})
        say(visitor, type="GuiUpdateMessage", uuid=uuid)
        say(visitor, type="GuiUpdateMessage", uuid=[uuid], updates={"value": 0.3})
        assert still_heard(page, visitor)

    def test_update_of_unknown_control_raises_message_error(self):
        said = msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": "none such", "updates": {"value": 1.0}})
        with pytest.raises(MessageError, match="a control that is not there"):
            check_message(said, lambda identifier: None)

    def test_messages_of_unsupported_type_are_ignored(self, page, visitor, capfd):
        kinds = ("FileTransferStartUpload", "GuiFormDirtyMessage", "GuiCloseModalMessage", "Message", "no such", 3)
        for kind in kinds:
            say(visitor, type=kind, uuid="x")
        say(visitor, uuid="x")
        visitor.wire.send(msgspec.msgpack.encode([1, 2]))
        assert still_heard(page, visitor)
        assert "Traceback" not in capfd.readouterr().err

    @pytest.mark.parametrize(
        "bad",
        [
            {"position": [math.nan] * 3},
            {"image_width": -1},
            {"image_width": 1e9},
            {"fov": 0.0},
            {"fov": 4.0},
            {"wxyz": [1.0]},
        ],
    )
    def test_message_with_invalid_camera_is_ignored(self, page, visitor, bad, capfd):
        axes = {"wxyz": [1, 0, 0, 0], "position": [0, 0, 1], "look_at": [0, 0, 0], "up_direction": [0, 1, 0]}
        good = axes | {"fov": 1.0, "near": 0.01, "far": 10.0, "image_height": 600, "image_width": 777}
        say(visitor, type="ViewerCameraMessage", **(good | bad))
        say(visitor, type="ViewerCameraMessage", **good, more=1)
        assert still_heard(page, visitor)
        (client,) = page.server.get_clients().values()
        assert client.camera.image_width == 1200
        assert "Traceback" not in capfd.readouterr().err

    @pytest.mark.parametrize(
        "bytes_", [b"", b"\xc1", b"\x81\xa1a" * 10000 + b"\x01", "text", b"\x81\xa4type\xa3\xff\xff\xff", b"a" * 70000]
    )
    def test_malformed_message_closes_only_its_connection(self, page, visitor, bytes_, capfd):
        hostile = connect(f"ws://127.0.0.1:{page.port}", subprotocols=PROTOCOL, max_size=None)
        hostile.send(bytes_)
        with pytest.raises(ConnectionClosed) as closed:
            for _ in range(1000):
                hostile.recv(timeout=10)
        assert closed.value.rcvd.code in (1008, 1009)
        assert still_heard(page, visitor)
        said = capfd.readouterr().err
        assert "Traceback" not in said and len(said.splitlines()) <= 1

    @pytest.mark.parametrize("shared", [{"max_burst": 50.0, "messages_per_second": 20.0}], indirect=True)
    def test_message_flood_closes_only_its_connection(self, page):
        hostile, begun = Visitor(page, 1200), time.monotonic()
        assert wait_for(lambda: page.visitors == 1)
        visitor = Visitor(page, 1200)
        assert wait_for(lambda: page.visitors == 2)
        with pytest.raises(ConnectionClosed):
            for number in range(100000):
                hostile.set(page.frame, 50 + number % 2)
        assert wait_for(lambda: page.visitors == 1)
        assert 10 < len(page.heard) <= 50 + 20 * (time.monotonic() - begun)
        page.heard.clear()
        assert still_heard(page, visitor)


def say(visitor, **message):
    visitor.wire.send(msgspec.msgpack.encode(message))
