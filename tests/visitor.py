"""A browser as the page's server sees one, without a browser: a bare web socket."""

import re
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import msgspec
import pytest
import viser
import zstandard
from viser import _messages
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from ar.page.browser import Browser


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def wait_for(reached: Callable[[], bool]) -> bool:
    until = time.monotonic() + 30.0
    while not reached() and time.monotonic() < until:
        time.sleep(0.02)
    return reached()


class Visitor:
    """Says where its camera is, gets messages, sends what its user does."""

    def __init__(self, page: Browser, width: int) -> None:
        address = page.address.replace("http", "ws")
        self.wire = connect(address, subprotocols=[f"viser-v{viser.__version__}"], max_size=None)
        self.received = 0
        # What the page's elements were set to, in that order.
        self.updates: list[dict] = []
        threading.Thread(target=self.listen, daemon=True).start()
        axes = {"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, 1.0), "look_at": (0.0, 0.0, 0.0)}
        self.say(
            _messages.ViewerCameraMessage(
                **axes, fov=1.0, near=0.01, far=10.0, image_height=600, image_width=width, up_direction=(0.0, 1.0, 0.0)
            )
        )

    def listen(self) -> None:
        with suppress(ConnectionClosed):
            for message in self.wire:
                self.received += len(message)
                assert isinstance(message, bytes)
                packed = int.from_bytes(message[8:16], "little")
                window = msgspec.msgpack.decode(zstandard.decompress(message[16 : 16 + packed]))
                self.updates += [each["updates"] for each in window["messages"] if "updates" in each]

    def say(self, message: _messages.Message) -> None:
        self.wire.send(msgspec.msgpack.encode(message.as_serializable_dict()))

    def set(self, handle: viser.GuiInputHandle, value: object) -> None:
        self.say(_messages.GuiUpdateMessage(handle._impl.uuid, {"value": value}))

    def hit(self, command: viser.CommandHandle) -> None:
        """Hit a command's key."""
        self.say(_messages.CommandTriggerMessage(command._impl.uuid))


def run_until(demo, monkeypatch, reached):
    """Let the loop run, once, until it has come to something."""
    show = demo.browser.show

    def shown(*known):
        show(*known)
        if reached():
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(demo.browser, "show", shown)
        demo.run(60.0)


def report(demo):
    """The words of the report, without their marks."""
    return re.sub("<[^>]*>", "|", demo.browser.shown[2])
