"""The page: the camera picture, a 3-D view beside it, playback, controls and a report, made with viser.

The overlay is composited into the picture before it comes here (`ar.overlay.composite`). The picture is shown whole, as
an image of its own. So no window shape and no client can bring the two out of register. The 3-D view follows by sending
vertices alone. `ar.page.style` says where things are.
"""

from __future__ import annotations

import threading
import time as clock
from collections.abc import Callable, Sequence

import cv2
import numpy as np
import viser

from .control_lock import Crowd, Inputs, noted
from .elements import ASIDE_SPOT, BACK, KEYS, LIVE_KEYS, ON, PICTURE, RECORD, SAID, SPACE, aside, coded, sight, unparted
from .guard import LIMITS, Limits, bracketed, check_address, open_server
from .parts import Body, Control, Deed, Fold, Note, Playback, Sign, Viewpoint
from .recording import Recorder
from .scene import add_body, dress
from .style import PAGE, STATUS, style

# Behind all that is added later.
LAST = 1e9
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
        origins: tuple[str, ...] = (),
    ) -> None:
        """Start the server; where `port` is taken, the next free one serves, see `address`.

        `words` is HTML under the picture, `size` the picture's width and height [pixel] until the first arrives.
        `origins` are further addresses of the page, of a proxy or another port, as `ar.page.guard.origin_of` has them.

        Raises
        ------
        ValueError
            A port that is none.
        OSError
            A host that is not this machine.
        UnguardedError
            A viser that serves otherwise than `ar.page.guard` knows.
        """
        check_address(host, port)
        self.limits, self.origins = limits, origins
        self.server, self.token = open_server(host, port, title, limits, origins)
        dress(self.server, viewpoint, signs)
        gui = self.server.gui
        gui.add_html(style(size[0] / size[1]))
        blank = np.full((size[1], size[0], 3), 24, np.uint8)
        gui.add_html(held(PICTURE, ""))
        # Last: where a low window has no room for them under the picture, the controls come before them.
        self.words = gui.add_html(held(PAGE, unparted(words)), order=LAST)
        self.line = gui.add_html("")
        self.text = gui.add_html(held(SAID, ""))
        # What is shown, newest first asked for: frame, picture and words; the picture as it is sent, and how many were.
        self.shown: Shown = (0, blank, "", 0)
        self.wanted: Shown = self.shown
        self.coded, self.sent = coded(blank), 0
        self.sight = gui.add_html(sight(0, self.coded, ""))
        gui.add_html(aside(KEYS if playback.frames else LIVE_KEYS))
        self.beside = gui.add_html("")
        # What draws slices and the last seconds, if they are others than those that were sent; when they may be [s].
        self.drawn: Callable[[], tuple[np.ndarray, str]] | None = None
        self.due = 0.0
        self.crowd, self.recorder = Crowd(self.server, self.text.order + 0.5), Recorder(self.server)
        self.controls = Inputs(self.server, self.crowd)
        self.newest: dict[str, Callable[[], object]] = {}
        self.lock, self.sending = threading.Lock(), threading.Lock()
        self.meshes: dict[str, viser.MeshHandle] = {}
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
                self.newest, self.drawn = {}, None
            for mesh in self.meshes.values():
                mesh.remove()
            if self.folder is not None:
                self.folder.remove()
            self.server.gui.set_panel_label(title)
            self.title = title
            self.words.content, self.line.content = held(PAGE, unparted(words)), ""
            self.wanted, self.shown = (0, self.shown[1], "", 0), (0, self.shown[1], self.shown[2], 0)
            self.report("")
            self.controls.clear()
            self.folder = self.server.gui.add_folder(None)
            with self.folder:
                self.add_playback(playback)
                # Before the controls: a window of 1280 x 720 does not hold them all.
                self.add_savers()
                for control in controls:
                    self.controls.add(control)
            self.meshes = {body.name: add_body(self.server, body) for body in bodies}

    @property
    def inputs(self) -> dict[str, viser.GuiInputHandle]:
        """The controls by their labels."""
        return self.controls.handles

    @property
    def deed(self) -> Deed | None:
        """What the newest message did, as the `changed` that it calls may ask."""
        return self.controls.deed

    @property
    def address(self) -> str:
        """Where the page is, as this machine reaches it, with the token that others than this machine need."""
        host = self.server.get_host()
        name = "localhost" if host in EVERYWHERE else bracketed(host)
        return f"http://{name}:{self.server.get_port()}" + (f"/?token={self.token}" if self.token else "")

    @property
    def addresses(self) -> list[str]:
        """Further addresses of the page, with the token."""
        return [f"{origin}/?token={self.token}" for origin in self.origins]

    @property
    def visitors(self) -> int:
        """How many browsers look at the page now."""
        return len(self.server.get_clients())

    @property
    def here(self) -> set[int]:
        """Numbers of the visitors who look at the page now, from 1 in the order that they came."""
        return self.crowd.here

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
        at = self.shown[3]
        if colour is not self.shown[1]:
            self.coded = coded(colour)
        if colour is not self.shown[1] or words != self.shown[2]:
            self.put_sight(self.coded, words)
        self.shown = wanted
        # Not oftener: a visitor may be moving it.
        if place != at:
            self.controls.assign(self.frame, place)

    def put_sight(self, code: str, words: str) -> None:
        """Send a `coded` picture and words, HTML, at once."""
        self.sent += 1
        self.sight.content = sight(self.sent, code, unparted(words))
        self.recorder.take(code)

    def show_beside(self, drawn: Callable[[], tuple[np.ndarray, str]]) -> None:
        """Show a picture (H, W, 3) uint8 of slices, and HTML of the last seconds, in tabs beside the 3-D view.

        `drawn` makes them, on the page's own thread, as often as `Limits` allow: what comes between is left out.
        """
        with self.lock:
            self.drawn = drawn

    def send_beside(self) -> None:
        """Draw and send the newest slices, where it is time and somebody looks."""
        with self.lock:
            drawn = self.drawn if clock.monotonic() >= self.due and self.visitors else None
            if drawn is None:
                return
            self.drawn, self.due = None, clock.monotonic() + 1.0 / self.limits.asides
        colour, words = drawn()
        self.sent += 1
        self.beside.content = sight(self.sent, coded(colour), words, ASIDE_SPOT)

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
        """Show each visitor a line of Markdown of its own under the report: `line` takes the visitor's number.

        Where several look, it is said besides who leads, and the others may ask to.
        """

        def send() -> None:
            if not self.closed.is_set():
                self.crowd.read(line)

        # There, no visitor leaves meanwhile.
        self.note("lines", lambda: self.server.get_event_loop().call_soon_threadsafe(send))

    def put(self, label: str, value: float | str, wanted: Callable[[], bool] | None = None) -> None:
        """Set a control without calling its `changed`, as when a script moves the tool.

        A slider stays within its ends. With `wanted` another value alone is set, if that returns True on the thread
        that hears the visitors.
        """
        control = self.controls.handles[label]
        if isinstance(control, viser.GuiSliderHandle) and not isinstance(value, str):
            value = min(max(value, control.min), control.max)
        self.note(f"control {label}", lambda: self.controls.assign(control, value, wanted))

    def write(self, label: str, words: str) -> None:
        """Put other words, HTML, into a note; without any it is not shown."""
        folder, text = self.controls.notes[label]

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
                self.send_beside()

    def add_playback(self, playback: Playback) -> None:
        """A button that plays and pauses, and a slider over the frames, if there are any; keys do the same."""
        gui, self.playing, seekable = self.server.gui, True, playback.frames > 0
        self.button = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self.frame = gui.add_slider("frame", 0, max(playback.frames - 1, 1), 1, 0, visible=seekable)

        def toggle(_: viser.ClientHandle | None = None) -> None:
            self.plays(not self.playing)
            playback.played(self.playing)

        def step(by: int) -> None:
            number = min(max(self.shown[0] + by, 0), playback.frames - 1)
            self.plays(False)
            playback.played(False)
            playback.sought(number)
            self.controls.assign(self.frame, number)

        self.controls.press(self.button, toggle)
        # The slider of a single frame has a second place: it must have a length.
        self.controls.hear(self.frame, lambda number: playback.sought(min(number, playback.frames - 1)))
        self.controls.command(SPACE, toggle)
        if seekable:
            self.controls.command(BACK, lambda _: step(-1))
            self.controls.command(ON, lambda _: step(1))

    def add_savers(self) -> None:
        """Buttons that download the picture as it is shown, for everybody, and a film, for who leads."""
        name = self.title.replace(":", "").replace(" ", "-")
        self.saver = self.server.gui.add_button("Save the picture", icon=viser.Icon.CAMERA, color="gray")

        @self.saver.on_click
        def save(event: viser.GuiEvent) -> None:
            if event.client is not None:
                number, colour, *_ = self.shown
                written = cv2.imencode(".png", np.ascontiguousarray(colour[..., ::-1]))[1]
                event.client.send_file_download(f"{name}-{number}.png", written.tobytes(), save_immediately=True)

        def record(client: viser.ClientHandle) -> None:
            self.recorder.toggle(client, self.coded)

        self.controls.press(self.recorder.add_button(name), record)
        self.controls.command(RECORD, record)


def held(name: str, words: str) -> str:
    """An element of the page that the rules find by its name."""
    return f'<div id="{name}">{words}</div>'
