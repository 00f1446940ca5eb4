"""The page: the camera picture, a 3-D view beside it, playback, controls and a report, made with viser.

The overlay is composited into the picture before it comes here, and the picture is shown whole, as an image of its own:
no window shape and no client can bring the two out of register. The 3-D view follows by sending vertices alone.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from .guard import bracketed, open_server

# A client that decodes more slowly than pictures arrive shows none at all.
PICTURES_PER_SECOND = 15.0
# Width of the panel with the picture [CSS pixel]: at most, at least, and as a share of the window.
PANEL = (676, 320, 0.56)
# Windows under this width [CSS pixel] get the panel as a sheet at the bottom.
NARROW = 576
# Hosts that this machine reaches by the name localhost.
EVERYWHERE = ("127.0.0.1", "0.0.0.0", "::1", "::")


@dataclass(frozen=True, eq=False)
class Body:
    """A surface in the 3-D view: vertices (V, 3) [m], triangles (F, 3), colour (3,) sRGB in [0, 1].

    The browser makes normals anew for each update: some 5,000 vertices for all bodies together stay fluent.
    """

    name: str
    vertices: np.ndarray
    triangles: np.ndarray
    colour: tuple[float, float, float] = (0.8, 0.8, 0.8)
    opacity: float = 1.0
    wireframe: bool = False


@dataclass(frozen=True)
class Slider:
    """A number that a visitor sets; `changed` takes it, on the page's own thread, and must return at once."""

    label: str
    low: float
    high: float
    step: float
    start: float
    changed: Callable[[float], None]


@dataclass(frozen=True)
class Choice:
    """One of several names; `changed` takes it, on the page's own thread, and must return at once."""

    label: str
    options: tuple[str, ...]
    start: str
    changed: Callable[[str], None]


@dataclass(frozen=True)
class Toggle:
    """Something that is on or off; `changed` takes which, on the page's own thread, and must return at once."""

    label: str
    start: bool
    changed: Callable[[bool], None]


@dataclass(frozen=True)
class Playback:
    """Play, pause and scrub over frames 0 .. frames - 1: `played` takes whether it plays, `sought` a frame number."""

    frames: int
    played: Callable[[bool], None]
    sought: Callable[[int], None]


@dataclass(frozen=True)
class Deed:
    """What a visitor set last: the visitor's number, from 1, and the label of the control."""

    visitor: int
    label: str


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Where the 3-D view starts: eye, target and up direction, (3,) [m]."""

    eye: np.ndarray
    target: np.ndarray
    up: np.ndarray


class Browser:
    """A screen in the browser, for any number of visitors, who share picture and controls.

    `show`, `move`, `report` and `put` only note what is newest and may be called from any thread at any rate; a
    thread of the page sends it on, 15 times a second at most.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        viewpoint: Viewpoint,
        playback: Playback,
        controls: Sequence[Slider | Choice | Toggle] = (),
        title: str = "sulcus",
        caption: str = "",
        host: str = "127.0.0.1",
        port: int = 8080,
        size: tuple[int, int] = (640, 480),
    ) -> None:
        """Start the server; where `port` is taken, the next free one serves, see `address`.

        `caption` is Markdown under the picture, `size` the picture's width and height [pixel] until the first arrives.

        Raises
        ------
        ValueError
            A port that is none.
        OSError
            A host that is not this machine.
        UnguardedError
            A viser that serves otherwise than `ar.guard` knows.
        """
        check_address(host, port)
        self.server, self.token = open_server(host, port, title)
        self.dress(title, viewpoint)
        gui = self.server.gui
        blank = np.full((size[1], size[0], 3), 24, np.uint8)
        self.picture = gui.add_image(blank, format="jpeg", jpeg_quality=88)
        self.add_playback(playback)
        self.text = gui.add_markdown("")
        self.inputs = {control.label: self.add_control(control) for control in controls}
        gui.add_markdown(caption)
        self.meshes = {body.name: self.add_body(body) for body in bodies}
        # What the newest message did, as the `changed` that it calls may ask.
        self.deed: Deed | None = None
        # The line that each visitor alone reads, by viser's identifier.
        self.lines: dict[int, viser.GuiMarkdownHandle] = {}
        self.newest: dict[str, Callable[[], object]] = {}
        self.lock = threading.Lock()
        self.closed = threading.Event()
        self.sender = threading.Thread(target=self.send, name="page", daemon=True)
        self.sender.start()

    @property
    def address(self) -> str:
        """Where the page is, as this machine reaches it, with the token that others than this machine need."""
        host = self.server.get_host()
        name = "localhost" if host in EVERYWHERE else bracketed(host)
        return f"http://{name}:{self.server.get_port()}" + (f"/?token={self.token}" if self.token else "")

    @property
    def visitors(self) -> int:
        """How many browsers look at the page now."""
        return len(self.server.get_clients())

    @property
    def here(self) -> set[int]:
        """Numbers of the visitors who look at the page now, from 1 in the order that they came."""
        return {identifier + 1 for identifier in self.server.get_clients()}

    def show(self, number: int, colour: np.ndarray) -> None:
        """Show the picture (H, W, 3) uint8 of frame `number`, and put the playback slider there."""

        def send() -> None:
            self.picture.image = colour
            self.assign(self.frame, number)

        self.note("picture", send)

    def move(self, name: str, vertices: np.ndarray, triangles: np.ndarray | None = None) -> None:
        """Put the vertices (V, 3) [m] of a body in the 3-D view elsewhere; triangles (F, 3) where they are others."""
        mesh = self.meshes[name]

        def send() -> None:
            if triangles is not None and not np.array_equal(mesh.faces, triangles):
                mesh.faces = np.asarray(triangles, np.uint32)
            mesh.vertices = np.asarray(vertices, np.float32)

        self.note(f"body {name}", send)

    def report(self, markdown: str) -> None:
        """Show Markdown text between playback and controls."""
        self.note("report", lambda: setattr(self.text, "content", markdown))

    def tell(self, line: Callable[[int], str]) -> None:
        """Show each visitor a line of Markdown of its own under the report: `line` takes the visitor's number."""

        def send() -> None:
            clients = {} if self.closed.is_set() else self.server.get_clients()
            self.lines = {identifier: text for identifier, text in self.lines.items() if identifier in clients}
            for identifier, client in clients.items():
                if identifier not in self.lines:
                    self.lines[identifier] = client.gui.add_markdown("", order=self.text.order + 0.5)
                content = line(identifier + 1)
                if self.lines[identifier].content != content:
                    self.lines[identifier].content = content

        # There, no visitor leaves meanwhile.
        self.note("lines", lambda: self.server.get_event_loop().call_soon_threadsafe(send))

    def put(self, label: str, value: float | str) -> None:
        """Set a control without calling its `changed`, as when a script moves the tool."""
        control = self.inputs[label]
        self.note(f"control {label}", lambda: self.assign(control, value))

    def close(self) -> None:
        """Stop the page."""
        self.closed.set()
        self.sender.join()
        self.server.stop()

    def note(self, key: str, send: Callable[[], object]) -> None:
        """Keep the newest thing to send of each kind."""
        with self.lock:
            self.newest[key] = send

    def send(self) -> None:
        """Send what is newest until the page is closed; all that came together arrives together."""
        while not self.closed.wait(1.0 / PICTURES_PER_SECOND):
            with self.lock:
                newest, self.newest = self.newest, {}
            with self.server.atomic():
                for send in newest.values():
                    send()

    def assign(self, control: viser.GuiInputHandle, value: float | str) -> None:
        """Set a control on the thread that hears the visitors: another could overwrite what is not yet read."""
        self.server.get_event_loop().call_soon_threadsafe(setattr, control, "value", value)

    def dress(self, title: str, viewpoint: Viewpoint) -> None:
        """Colours, light, the panel's place and the first view of the 3-D scene."""
        gui, scene = self.server.gui, self.server.scene
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="large")
        gui.set_panel_label(title)
        gui.main_panel.dock_left()
        # Two soft lights from the first viewpoint's sides: the page's own four wash the colours out.
        scene.configure_default_lights(enabled=False)
        scene.add_light_ambient("/light/ambient", intensity=0.9)
        across = np.cross(np.asarray(viewpoint.target) - viewpoint.eye, viewpoint.up)
        for name, side, strength in (("left", -1.0, 1.8), ("right", 1.0, 0.6)):
            place = np.asarray(viewpoint.eye) + side * across / np.linalg.norm(across)
            scene.add_light_directional(f"/light/{name}", intensity=strength, position=tuple(place))
        start = self.server.initial_camera
        start.position, start.look_at = tuple(viewpoint.eye), tuple(viewpoint.target)
        start.up = tuple(viewpoint.up)

        @self.server.on_client_connect
        def fit(client: viser.ClientHandle) -> None:
            most, least, share = PANEL
            client.gui.main_panel.set_width(float(np.clip(share * client.camera.image_width, least, most)))
            if client.camera.image_width < NARROW:
                # The panel is a sheet over the lower half there: bring the scene into the upper one.
                arm = np.asarray(viewpoint.eye) - viewpoint.target
                target = viewpoint.target - 0.35 * np.linalg.norm(arm) * np.asarray(viewpoint.up)
                client.camera.position, client.camera.look_at = tuple(target + 1.5 * arm), tuple(target)

    def add_playback(self, playback: Playback) -> None:
        """A button that plays and pauses, and a slider over the frames."""
        gui = self.server.gui
        self.button = button = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self.frame = gui.add_slider("frame", 0, max(playback.frames - 1, 1), 1, 0)

        @button.on_click
        def toggle(_: viser.GuiEvent) -> None:
            plays = button.label == "Play"
            button.label = "Pause" if plays else "Play"
            button.icon = viser.Icon.PLAYER_PAUSE if plays else viser.Icon.PLAYER_PLAY
            playback.played(plays)

        # The slider of a single frame has a second place: it must have a length.
        self.hear(self.frame, lambda number: playback.sought(min(number, playback.frames - 1)))

    def add_control(self, control: Slider | Choice | Toggle) -> viser.GuiInputHandle:
        """A slider, a list or a box to tick."""
        gui = self.server.gui
        if isinstance(control, Toggle):
            box = gui.add_checkbox(control.label, control.start)
            self.hear(box, control.changed)
            return box
        if isinstance(control, Slider):
            slider = gui.add_slider(control.label, control.low, control.high, control.step, control.start)
            self.hear(slider, control.changed)
            return slider
        menu = gui.add_dropdown(control.label, control.options, initial_value=control.start)
        self.hear(menu, control.changed)
        return menu

    def hear(self, control: viser.GuiInputHandle, changed: Callable[[Any], None]) -> None:
        """Pass on what visitors set, on the thread that they are heard on, before anything else happens there."""

        @control.on_update
        async def update(event: viser.GuiEvent) -> None:
            # The page's own updates come through here too, without a client.
            if event.client is not None:
                self.deed = Deed(event.client.client_id + 1, control.label)
                changed(control.value)

    def add_body(self, body: Body) -> viser.MeshHandle:
        """A surface in the 3-D view, seen from both sides."""
        return self.server.scene.add_mesh_simple(
            f"/{body.name}",
            np.asarray(body.vertices, np.float32),
            np.asarray(body.triangles, np.uint32),
            color=np.asarray(body.colour, np.float64),
            opacity=None if body.opacity >= 1.0 else body.opacity,
            wireframe=body.wireframe,
            side="double",
        )


def check_address(host: str, port: int) -> None:
    """Raise where no page can be served: viser would fail on a thread of its own, and its maker wait for ever.

    Raises
    ------
    ValueError
        A port outside 0 .. 65535.
    OSError
        A host that is not this machine.
    """
    if not 0 <= port <= 65535:
        raise ValueError(f"{port} is no port: give 0 .. 65535.")
    family = socket.getaddrinfo(host, None)[0][0]
    with socket.create_server((host, 0), family=family):
        pass
