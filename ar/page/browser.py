"""Browser page made with viser: camera image, 3-D view, playback, controls and a report.

The image already contains the overlay of `ar.overlay.composite`. The page shows it as one element, so that image and
overlay stay aligned in every window. Updates of the 3-D view send only vertices. `ar.page.style` has the layout.
"""

import threading
import time as clock
from collections.abc import Callable, Sequence

import cv2
import numpy as np
import viser

from .access_guard import DEFAULT_LIMITS, ConnectionLimits, check_address, open_server, to_url_host
from .control_lock import Clients, Inputs, format_note
from .elements import (
    ASIDE_SPOT,
    BACK_KEY,
    KEYS,
    LIVE_KEYS,
    ON_KEY,
    PICTURE,
    PLAY_KEY,
    RECORD_KEY,
    SAID,
    build_image_element,
    build_tabs,
    keep_numbers_together,
    to_data_url,
)
from .parts import Control, Folder, LastChange, Note, Playback, SceneImage, SceneLabel, SceneSurface, SceneViewpoint
from .recording import Recorder
from .scene import add_surface, fill_scene
from .style import PAGE, STATUS, build_style

LAST_ORDER = 1e9  # Sort order that keeps an element last on the page.
LOCAL_ADDRESSES = ("127.0.0.1", "0.0.0.0", "::1", "::")  # Addresses that this machine reaches by the name localhost.


Shown = tuple[int, np.ndarray, str, int]
"""Frame number, image (H, W, 3) uint8 of the frame, report next to it (HTML), and position of the playback slider."""


class Browser:
    """Browser page for any number of clients, who share image and controls.

    `show`, `move`, `report`, `write` and `put` only store the newest value; they may be called from any thread, at any
    rate. A thread of the page sends the stored values, as often as `ConnectionLimits` allow.
    """

    def __init__(
        self, bodies: Sequence[SceneSurface], viewpoint: SceneViewpoint, playback: Playback,
        controls: Sequence[Control | Folder | Note] = (), title: str = "sulcus", words: str = "",
        host: str = "127.0.0.1", port: int = 8080, size: tuple[int, int] = (640, 480),
        signs: Sequence[SceneLabel | SceneImage] = (), limits: ConnectionLimits = DEFAULT_LIMITS,
        origins: tuple[str, ...] = (),
    ) -> None:  # fmt: skip
        """Start the server; if `port` is in use, the next free port is taken, see `address`.

        `words` is HTML below the image. `size` is the image's width and height [pixel] until the first one arrives.
        `origins` are further addresses of the page, by a proxy or another port, as from `access_guard.format_origin`.

        Raises
        ------
        ValueError
            The port is invalid.
        OSError
            The host is not this machine.
        ViserError
            The viser release is not supported by `ar.page.access_guard`.
        """
        check_address(host, port)
        self.limits, self.origins = limits, origins
        self.server, self.token = open_server(host, port, title, limits, origins)
        fill_scene(self.server, viewpoint, signs)
        gui = self.server.gui
        gui.add_html(build_style(size[0] / size[1]))
        blank = np.full((size[1], size[0], 3), 24, np.uint8)
        gui.add_html(build_element(PICTURE, ""))
        # The words come last: in a low window without space under the image, the controls precede them.
        self.words = gui.add_html(build_element(PAGE, keep_numbers_together(words)), order=LAST_ORDER)
        self.line = gui.add_html("")
        self.text = gui.add_html(build_element(SAID, ""))
        # Shown and requested state: frame, image and words. Last encoded image, and number of images sent.
        self.shown: Shown = (0, blank, "", 0)
        self.wanted: Shown = self.shown
        self.coded, self.sent = to_data_url(blank), 0
        self.sight = gui.add_html(build_image_element(0, self.coded, ""))
        gui.add_html(build_tabs(KEYS if playback.frame_count else LIVE_KEYS, bodies))
        self.beside = gui.add_html("")
        # Function that draws slices and charts, if not yet sent; earliest time to send them [s].
        self.drawn: Callable[[], tuple[np.ndarray, str]] | None = None
        self.due = 0.0
        self.crowd, self.recorder = Clients(self.server, self.text.order + 0.5), Recorder(self.server)
        self.controls = Inputs(self.server, self.crowd)
        self.newest: dict[str, Callable[[], object]] = {}
        self.lock, self.sending = threading.Lock(), threading.Lock()
        self.meshes: dict[str, viser.MeshHandle] = {}
        self.folder: viser.GuiFolderHandle | None = None
        self.fill(bodies, playback, controls, title, words)
        self.closed = threading.Event()
        self.sender = threading.Thread(target=self.send_updates, name="page", daemon=True)
        self.sender.start()

    def fill(
        self, bodies: Sequence[SceneSurface], playback: Playback, controls: Sequence[Control | Folder | Note] = (),
        title: str = "sulcus", words: str = "",
    ) -> None:  # fmt: skip
        """Replace surfaces, playback, controls, title and text of the page.

        Pending updates of the previous ones are dropped.
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
            self.words.content, self.line.content = build_element(PAGE, keep_numbers_together(words)), ""
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
            self.meshes = {body.name: add_surface(self.server, body) for body in bodies}

    @property
    def inputs(self) -> dict[str, viser.GuiInputHandle]:
        """Controls by their labels."""
        return self.controls.handles

    @property
    def deed(self) -> LastChange | None:
        """Action of the newest message, for the callback that the message triggers."""
        return self.controls.deed

    @property
    def address(self) -> str:
        """Address of the page for this machine, with the token that other machines need."""
        host = self.server.get_host()
        name = "localhost" if host in LOCAL_ADDRESSES else to_url_host(host)
        return f"http://{name}:{self.server.get_port()}" + (f"/?token={self.token}" if self.token else "")

    @property
    def addresses(self) -> list[str]:
        """Further addresses of the page (`origins`), with the token."""
        return [f"{origin}/?token={self.token}" for origin in self.origins]

    @property
    def visitors(self) -> int:
        """Number of connected browsers."""
        return len(self.server.get_clients())

    @property
    def here(self) -> set[int]:
        """Numbers of the connected clients, from 1 in order of arrival."""
        return self.crowd.here

    def show(self, number: int, colour: np.ndarray, words: str, sought: int | None = None) -> None:
        """Show the image (H, W, 3) uint8 of frame `number`, with its report (HTML).

        The playback slider moves to `number` or, if given, to the target frame `sought`, which this frame precedes.
        """
        with self.lock:
            self.wanted = number, colour, words, number if sought is None else sought
            self.newest["sight"] = self.send_image

    def report(self, words: str) -> None:
        """Replace the report (HTML) next to the image."""
        with self.lock:
            self.wanted = self.wanted[0], self.wanted[1], words, self.wanted[3]
            self.newest["sight"] = self.send_image

    def send_image(self) -> None:
        """Send the image with its report, unless both are already shown."""
        with self.lock:
            _, colour, words, place = wanted = self.wanted
        at = self.shown[3]
        if colour is not self.shown[1]:
            self.coded = to_data_url(colour)
        if colour is not self.shown[1] or words != self.shown[2]:
            self.send_image_element(self.coded, words)
        self.shown = wanted
        # Set the slider only on a change: a client may be moving it.
        if place != at:
            self.controls.assign(self.frame, place)

    def send_image_element(self, data_url: str, html: str) -> None:
        """Send a `to_data_url` image and its text (HTML) immediately."""
        self.sent += 1
        self.sight.content = build_image_element(self.sent, data_url, keep_numbers_together(html))
        self.recorder.add_image(data_url)

    def show_side_panels(self, render: Callable[[], tuple[np.ndarray, str]]) -> None:
        """Show an image (H, W, 3) uint8 of slices, and charts (HTML), in the tabs next to the 3-D view.

        The page's thread calls `render` to compute both, as often as `ConnectionLimits` allow; only the newest `render`
        is called.
        """
        with self.lock:
            self.drawn = render

    def send_side_panels(self) -> None:
        """Draw and send the newest slices and charts, if due and if a client is connected."""
        with self.lock:
            drawn = self.drawn if clock.monotonic() >= self.due and self.visitors else None
            if drawn is None:
                return
            self.drawn, self.due = None, clock.monotonic() + 1.0 / self.limits.slice_updates_per_second
        colour, words = drawn()
        self.sent += 1
        self.beside.content = build_image_element(self.sent, to_data_url(colour), words, ASIDE_SPOT)

    def move(self, name: str, vertices: np.ndarray, triangles: np.ndarray | None = None) -> None:
        """Replace the vertices (V, 3) [m] of a surface in the 3-D view, and the triangles (F, 3) if they changed."""
        mesh = self.meshes[name]

        def send_mesh() -> None:
            if triangles is not None and not np.array_equal(mesh.faces, triangles):
                mesh.faces = np.asarray(triangles, np.uint32)
            mesh.vertices = np.asarray(vertices, np.float32)

        self.store_update(f"body {name}", send_mesh)

    def tint(self, name: str, colour: tuple[float, float, float]) -> None:
        """Set the colour (3,), sRGB in [0, 1], of a surface in the 3-D view."""
        mesh = self.meshes[name]
        self.store_update(f"colour {name}", lambda: setattr(mesh, "color", tuple(round(255 * part) for part in colour)))

    def show_status(self, words: str) -> None:
        """Show a status line (HTML) over the image; an empty text hides it."""
        said = build_element(STATUS, f"<span>{words}</span>") if words else ""
        self.store_update("status", lambda: setattr(self.line, "content", said))

    def show_playback(self, playing: bool) -> None:
        """Set the play/pause button to the playback state `playing`."""
        button, self.playing = self.button, playing

        def send_button() -> None:
            button.label = "Pause" if playing else "Play"
            button.icon = viser.Icon.PLAYER_PAUSE if playing else viser.Icon.PLAYER_PLAY

        self.store_update("button", send_button)

    def show_line(self, line: Callable[[int], str]) -> None:
        """Show each client its own line of Markdown below the report; `line` maps the client's number to the text.

        If there are several clients, the line also says who has control, and others may request control.
        """

        def send_lines() -> None:
            if not self.closed.is_set():
                self.crowd.show_lines(line)

        # While this thread runs `send`, no client leaves.
        self.store_update("lines", lambda: self.server.get_event_loop().call_soon_threadsafe(send_lines))

    def put(self, label: str, value: float | str, wanted: Callable[[], bool] | None = None) -> None:
        """Set a control without calling its `on_change`, for example when a script moves the tool.

        A slider stays within its range. If `wanted` is given, the control is set only if the value differs and `wanted`
        returns True, in the thread that receives messages.
        """
        control = self.controls.handles[label]
        if isinstance(control, viser.GuiSliderHandle) and not isinstance(value, str):
            value = min(max(value, control.min), control.max)
        self.store_update(f"control {label}", lambda: self.controls.assign(control, value, wanted))

    def rename(self, label: str, words: str) -> None:
        """Show another text for a control; an unknown label, such as one of the previous scene, is ignored."""
        if (control := self.controls.handles.get(label)) is not None:
            self.store_update(f"words {label}", lambda: setattr(control, "label", words))

    def write(self, label: str, html: str) -> None:
        """Replace the text (HTML) of a note; an empty note is hidden."""
        folder, text = self.controls.notes[label]

        def send_text() -> None:
            text.content, folder.visible = format_note(html), bool(html)

        self.store_update(f"note {label}", send_text)

    def close(self) -> None:
        """Stop the page's thread and its server."""
        self.closed.set()
        self.sender.join()
        self.server.stop()

    def store_update(self, key: str, send: Callable[[], object]) -> None:
        """Store the newest update of each kind until it is sent."""
        with self.lock:
            self.newest[key] = send

    def send_updates(self) -> None:
        """Send the stored updates until the page is closed; updates of one interval arrive together."""
        while not self.closed.wait(1.0 / self.limits.updates_per_second):
            with self.sending:
                with self.lock:
                    newest, self.newest = self.newest, {}
                with self.server.atomic():
                    for send in newest.values():
                        send()
                self.send_side_panels()

    def add_playback(self, playback: Playback) -> None:
        """Add a play/pause button and, if there are frames, a slider over them; keys have the same actions."""
        gui, self.playing, seekable = self.server.gui, True, playback.frame_count > 0
        self.button = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self.frame = gui.add_slider("frame", 0, max(playback.frame_count - 1, 1), 1, 0, visible=seekable)

        def toggle_playback(_: viser.ClientHandle | None = None) -> None:
            self.show_playback(not self.playing)
            playback.on_play(self.playing)

        def step_frame(change: int) -> None:
            number = min(max(self.shown[0] + change, 0), playback.frame_count - 1)
            self.show_playback(False)
            playback.on_play(False)
            playback.on_seek(number)
            self.controls.assign(self.frame, number)

        self.controls.bind_button(self.button, toggle_playback)
        # A slider needs two positions, even for a single frame.
        self.controls.receive_input(self.frame, lambda number: playback.on_seek(min(number, playback.frame_count - 1)))
        self.controls.bind_key(PLAY_KEY, toggle_playback)
        if seekable:
            self.controls.bind_key(BACK_KEY, lambda _: step_frame(-1))
            self.controls.bind_key(ON_KEY, lambda _: step_frame(1))

    def add_savers(self) -> None:
        """Add buttons to download the shown image (every client) and to record a video (client with control)."""
        name = self.title.replace(":", "").replace(" ", "-")
        self.saver = self.server.gui.add_button("Save the image", icon=viser.Icon.CAMERA, color="gray")

        @self.saver.on_click
        def save_image(event: viser.GuiEvent) -> None:
            if event.client is not None:
                number, colour, *_ = self.shown
                written = cv2.imencode(".png", np.ascontiguousarray(colour[..., ::-1]))[1]
                event.client.send_file_download(f"{name}-{number}.png", written.tobytes(), save_immediately=True)

        def toggle_recording(client: viser.ClientHandle) -> None:
            self.recorder.toggle_recording(client, self.coded)

        self.controls.bind_button(self.recorder.add_button(name), toggle_recording)
        self.controls.bind_key(RECORD_KEY, toggle_recording)

    # Former names, for one release.
    status, plays, show_beside, send = show_status, show_playback, show_side_panels, send_updates
    send_sight, put_sight, note = send_image, send_image_element, store_update


def build_element(name: str, html: str) -> str:
    """Wrap text in an element with an id, for style rules."""
    return f'<div id="{name}">{html}</div>'
