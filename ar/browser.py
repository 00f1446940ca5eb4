"""The page: the camera picture, a 3-D view beside it, playback, controls and a report, made with viser.

The overlay is composited into the picture before it comes here (`ar.overlay`), and the picture is shown whole, as an
image of its own. So no window shape and no client can bring the two out of register. The 3-D view follows by sending
vertices alone. `ar.page_style` says where things are.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
import viser

from .guard import LIMITS, Limits, bracketed, open_server
from .page_parts import Body, Choice, Control, Deed, Fold, Note, Playback, Sign, Slider, Toggle, Viewpoint
from .page_sight import PICTURE, SAID, coded, sight
from .page_style import NOTE, PAGE, STATUS, style

# Behind all that is added later.
LAST = 1e9
# Width of the docked panel where a browser does not know the page's own rules [CSS pixel].
PANEL = 676.0
# Hosts that this machine reaches by the name localhost.
EVERYWHERE = ("127.0.0.1", "0.0.0.0", "::1", "::")


Shown = tuple[int, np.ndarray, str, int]
"""A frame's number, its picture (H, W, 3) uint8, the words, HTML, beside it, and where the playback slider is."""


class Browser:
    """A screen in the browser, for any number of visitors, who share picture and controls.

    `show`, `move`, `report`, `write` and `put` only note what is newest. They may be called from any thread at any
    rate. A thread of the page sends it on, as often as `Limits` allow.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        viewpoint: Viewpoint,
        playback: Playback,
        controls: Sequence[Control | Fold | Note] = (),
        title: str = "sulcus",
        words: str = "",
        host: str = "127.0.0.1",
        port: int = 8080,
        size: tuple[int, int] = (640, 480),
        signs: Sequence[Sign] = (),
        limits: Limits = LIMITS,
    ) -> None:
        """Start the server; where `port` is taken, the next free one serves, see `address`.

        `words` is HTML under the picture, `size` the picture's width and height [pixel] until the first arrives.

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
        self.limits = limits
        self.server, self.token = open_server(host, port, title, limits)
        self.dress(viewpoint, signs)
        gui = self.server.gui
        gui.add_html(style(size[0] / size[1]))
        blank = np.full((size[1], size[0], 3), 24, np.uint8)
        gui.add_html(held(PICTURE, ""))
        # Last: where a low window has no room for them under the picture, the controls come before them.
        self.words = gui.add_html(held(PAGE, words), order=LAST)
        self.line = gui.add_html("")
        self.text = gui.add_html(held(SAID, ""))
        # What is shown, newest first asked for: frame, picture and words; the picture as it is sent, and how many were.
        self.shown: Shown = (0, blank, "", 0)
        self.wanted: Shown = self.shown
        self.coded, self.sent = coded(blank), 0
        self.sight = gui.add_html(sight(0, self.coded, ""))
        # What the newest message did, as the `changed` that it calls may ask.
        self.deed: Deed | None = None
        # The line that each visitor alone reads, by viser's identifier.
        self.lines: dict[int, viser.GuiMarkdownHandle] = {}
        self.newest: dict[str, Callable[[], object]] = {}
        self.lock, self.sending = threading.Lock(), threading.Lock()
        self.meshes: dict[str, viser.MeshHandle] = {}
        self.notes: dict[str, tuple[viser.GuiFolderHandle, viser.GuiHtmlHandle]] = {}
        self.folder: viser.GuiFolderHandle | None = None
        self.fill(bodies, playback, controls, title, words)
        self.closed = threading.Event()
        self.sender = threading.Thread(target=self.send, name="page", daemon=True)
        self.sender.start()

    def fill(
        self,
        bodies: Sequence[Body],
        playback: Playback,
        controls: Sequence[Control | Fold | Note] = (),
        title: str = "sulcus",
        words: str = "",
    ) -> None:
        """Put other bodies, playback, controls, title and words in the place of those that are there.

        What was noted for the old ones is dropped.
        """
        with self.sending, self.server.atomic():
            with self.lock:
                self.newest = {}
            for mesh in self.meshes.values():
                mesh.remove()
            if self.folder is not None:
                self.folder.remove()
            self.server.gui.set_panel_label(title)
            self.title = title
            self.words.content, self.line.content = held(PAGE, words), ""
            self.wanted, self.shown = (0, self.shown[1], "", 0), (0, self.shown[1], self.shown[2], 0)
            self.report("")
            self.inputs: dict[str, viser.GuiInputHandle] = {}
            self.notes = {}
            self.folder = self.server.gui.add_folder(None)
            with self.folder:
                self.add_playback(playback)
                # Before the controls: a window of 1280 x 720 does not hold them all.
                self.add_saver()
                for control in controls:
                    self.add_control(control)
            self.meshes = {body.name: self.add_body(body) for body in bodies}

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

    def show(self, number: int, colour: np.ndarray, words: str, sought: int | None = None) -> None:
        """Show the picture (H, W, 3) uint8 of frame `number`, and its words in HTML.

        The playback slider goes to that number. Of a frame on the way to another, `sought`, it goes to the other's.
        """
        with self.lock:
            self.wanted = number, colour, words, number if sought is None else sought
            self.newest["sight"] = self.send_sight

    def report(self, words: str) -> None:
        """Show other words, HTML, beside the picture."""
        with self.lock:
            self.wanted = self.wanted[0], self.wanted[1], words, self.wanted[3]
            self.newest["sight"] = self.send_sight

    def send_sight(self) -> None:
        """Send the picture with its words, unless both are there."""
        with self.lock:
            _, colour, words, place = wanted = self.wanted
        if colour is not self.shown[1]:
            self.coded = coded(colour)
        if colour is not self.shown[1] or words != self.shown[2]:
            self.put_sight(self.coded, words)
        # Not oftener: a visitor may be moving it.
        if place != self.shown[3]:
            self.assign(self.frame, place)
        self.shown = wanted

    def put_sight(self, code: str, words: str) -> None:
        """Send a `coded` picture and words, HTML, at once."""
        self.sent += 1
        self.sight.content = sight(self.sent, code, words)

    def move(self, name: str, vertices: np.ndarray, triangles: np.ndarray | None = None) -> None:
        """Put the vertices (V, 3) [m] of a body in the 3-D view elsewhere; triangles (F, 3) where they are others."""
        mesh = self.meshes[name]

        def send() -> None:
            if triangles is not None and not np.array_equal(mesh.faces, triangles):
                mesh.faces = np.asarray(triangles, np.uint32)
            mesh.vertices = np.asarray(vertices, np.float32)

        self.note(f"body {name}", send)

    def tint(self, name: str, colour: tuple[float, float, float]) -> None:
        """Give a body in the 3-D view another colour (3,), sRGB in [0, 1]."""
        mesh = self.meshes[name]
        self.note(f"colour {name}", lambda: setattr(mesh, "color", tuple(round(255 * part) for part in colour)))

    def status(self, words: str) -> None:
        """Show a line, HTML, over the picture, or none."""
        said = held(STATUS, f"<span>{words}</span>") if words else ""
        self.note("status", lambda: setattr(self.line, "content", said))

    def plays(self, playing: bool) -> None:
        """Let the button say whether the scene plays."""
        button, self.playing = self.button, playing

        def send() -> None:
            button.label = "Pause" if playing else "Play"
            button.icon = viser.Icon.PLAYER_PAUSE if playing else viser.Icon.PLAYER_PLAY

        self.note("button", send)

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

    def write(self, label: str, words: str) -> None:
        """Put other words, HTML, into a note; without any it is not shown."""
        folder, text = self.notes[label]

        def send() -> None:
            text.content, folder.visible = noted(words), bool(words)

        self.note(f"note {label}", send)

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
        while not self.closed.wait(1.0 / self.limits.sendings):
            with self.sending:
                with self.lock:
                    newest, self.newest = self.newest, {}
                with self.server.atomic():
                    for send in newest.values():
                        send()

    def assign(self, control: viser.GuiInputHandle, value: float | str) -> None:
        """Set a control on the thread that hears the visitors: another could overwrite what is not yet read."""

        def put() -> None:
            # The page may have been filled anew meanwhile.
            if control is self.frame or control in self.inputs.values():
                control.value = value

        self.server.get_event_loop().call_soon_threadsafe(put)

    def dress(self, viewpoint: Viewpoint, signs: Sequence[Sign]) -> None:
        """Colours, light, signs, the panel's place and the first view of the 3-D scene."""
        gui, scene = self.server.gui, self.server.scene
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="large")
        gui.main_panel.dock_left()
        gui.main_panel.set_width(PANEL)
        # Two soft lights from the first viewpoint's sides: the page's own four wash the colours out.
        scene.configure_default_lights(enabled=False)
        scene.add_light_ambient("/light/ambient", intensity=2.0)
        across = np.cross(np.asarray(viewpoint.target) - viewpoint.eye, viewpoint.up)
        for name, side, strength in (("left", -1.0, 2.2), ("right", 1.0, 1.0)):
            place = np.asarray(viewpoint.eye) + side * across / np.linalg.norm(across)
            scene.add_light_directional(f"/light/{name}", intensity=strength, position=tuple(place))
        for sign in signs:
            scene.add_label(f"/sign/{sign.word}", sign.word, position=np.asarray(sign.place), anchor="center-center")
        start = self.server.initial_camera
        start.position, start.look_at = tuple(viewpoint.eye), tuple(viewpoint.target)
        start.up, start.fov = tuple(viewpoint.up), viewpoint.fov

    def add_playback(self, playback: Playback) -> None:
        """A button that plays and pauses, and a slider over the frames."""
        gui = self.server.gui
        self.playing = True
        self.button = button = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self.frame = gui.add_slider("frame", 0, max(playback.frames - 1, 1), 1, 0)

        @button.on_click
        def toggle(_: viser.GuiEvent) -> None:
            self.plays(not self.playing)
            playback.played(self.playing)

        # The slider of a single frame has a second place: it must have a length.
        self.hear(self.frame, lambda number: playback.sought(min(number, playback.frames - 1)))

    def add_saver(self) -> None:
        """A button that downloads the picture as it is shown."""
        self.saver = self.server.gui.add_button("Save the picture", icon=viser.Icon.CAMERA, color="gray")

        @self.saver.on_click
        def save(event: viser.GuiEvent) -> None:
            if event.client is not None:
                number, colour, *_ = self.shown
                name = f"{self.title.replace(':', '').replace(' ', '-')}-{number}.png"
                written = cv2.imencode(".png", np.ascontiguousarray(colour[..., ::-1]))[1]
                event.client.send_file_download(name, written.tobytes(), save_immediately=True)

    def add_control(self, control: Control | Fold | Note) -> None:
        """A slider, a list, a box to tick, a folder of them, or a folder of words."""
        gui = self.server.gui
        if isinstance(control, Note):
            with gui.add_folder(control.label, expand_by_default=False, visible=bool(control.words)) as folder:
                self.notes[control.label] = folder, gui.add_html(noted(control.words))
            return
        if isinstance(control, Fold):
            with gui.add_folder(control.label, expand_by_default=False):
                for inner in control.controls:
                    self.add_control(inner)
            return
        words, hint = control.words or control.label, control.hint
        match control:
            case Toggle():
                handle = gui.add_checkbox(words, control.start, hint=hint)
            case Slider():
                handle = gui.add_slider(words, control.low, control.high, control.step, control.start, hint=hint)
            case Choice():
                handle = gui.add_dropdown(words, control.options, initial_value=control.start, hint=hint)
        self.inputs[control.label] = handle
        self.hear(handle, control.changed)

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


def held(name: str, words: str) -> str:
    """An element of the page that the rules find by its name."""
    return f'<div id="{name}">{words}</div>'


def noted(words: str) -> str:
    """The words of a note, which the rules find by their class."""
    return f'<div class="{NOTE}">{words}</div>'


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
