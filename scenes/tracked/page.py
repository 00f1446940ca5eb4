"""Page that shows a video or a live camera with the tumour overlay."""

import time as clock
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from html import escape

import numpy as np

from ar.overlay.composite import DOUBTFUL_COLOUR
from ar.overlay.gauge import DistanceGauge
from ar.overlay.styles import Style
from ar.page.browser import Browser
from ar.page.history import History
from ar.page.parts import Playback, SceneSurface
from ar.tracking.image_sequences import NamedImage

from ..page.controls import build_slice_control, build_style_controls
from ..page.view import STALE_COLOUR, build_brain, choose_viewpoint, list_orientation_labels
from ..play.stage import TOOL_COLOUR, TUMOUR_COLOUR
from ..play.waiting_notice import WaitingNotice
from .follower import MAX_INTERVAL, Follower, TrackingResult, TumourState
from .overlay_painter import GREY_STATES, Painter
from .overlay_panels import build_history_sample, list_plot_lines, render_slices
from .overlay_text import describe_overlay, format_report
from .run import Overlay, TimedImage, overlay_image
from .seekable_video import SeekableVideo

FADED_BRIGHTNESS = 0.35  # Brightness factor of an outdated image.
FAILURE_TIME = 2.0  # Time for which the page stays after a failure [s].
POLL_INTERVAL = 0.03  # Polling interval of an idle page [s].
UNPLUGGED_TIME = 1.0  # Time without an image after which a camera may be unplugged [s].
MAX_KEPT_RESULTS = 20_000  # Number of results kept for a table and a summary, without their colours.


@dataclass(eq=False)
class OverlayPage:
    """Page that shows one video or one camera with the tumour overlay.

    Parameters
    ----------
    follower, painter
        Tracker of the images, and renderer of the overlay.
    name, model
        Name of the video or the camera, and description of the deformation model.
    host, port
        Address of the server.
    frames
        Number of images of the video; 0: live camera.
    origins
        Further addresses of the page, see `ar.page.browser.Browser`.
    """

    follower: Follower
    painter: Painter
    name: str = "camera"
    model: str = "nobody"
    host: str = "127.0.0.1"
    port: int = 8080
    frames: int = 0
    origins: tuple[str, ...] = ()
    browser: Browser = field(init=False)
    notice: WaitingNotice = field(init=False)
    history: History = field(init=False)
    overlays: deque[Overlay] = field(default_factory=lambda: deque(maxlen=MAX_KEPT_RESULTS), init=False)
    # Requests of users, written by the page's threads.
    plays: bool = field(default=True, init=False)
    style: Style = field(init=False)
    through: str = field(default="", init=False)
    requested: deque[int] = field(default_factory=lambda: deque(maxlen=1), init=False)
    # Displayed state: the original image, its overlay, and its style.
    source: TimedImage | None = field(default=None, init=False)
    newest: Overlay | None = field(default=None, init=False)
    number: int = field(default=-1, init=False)
    # Shortest interval between two images up to now [s].
    interval: float = field(default=MAX_INTERVAL, init=False)
    image_name: str = field(default="", init=False)
    drawn_style: tuple[str, ...] = field(default=(), init=False)
    tints: dict[str, tuple[float, float, float]] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        """Open the page in a server; for errors see `ar.page.browser.Browser`."""
        stage, tool, calibration = self.painter.stage, self.painter.tool, self.follower.calibration
        self.style, self.history = self.painter.style, History(list_plot_lines(self.has_tool))
        bodies = build_brain(stage)
        if tool is not None:
            # Empty until the tool is visible.
            away = np.tile(stage.site.origin, (len(tool.bare_mesh[0]), 1))
            bodies.append(SceneSurface("tool", away, tool.bare_mesh[1], TOOL_COLOUR))
        self.browser = Browser(
            bodies,
            choose_viewpoint(stage.site),
            Playback(self.frames, lambda playing: setattr(self, "plays", playing), self.requested.append),
            [
                build_style_controls(self.style, lambda style: setattr(self, "style", style)),
                build_slice_control(self.through, lambda name: setattr(self, "through", name)),
            ],
            title=f"sulcus: {self.name}",
            words=describe_overlay(self.name, self.model, self.has_tool),
            host=self.host,
            port=self.port,
            size=(calibration.width, calibration.height),
            signs=list_orientation_labels(stage.site),
            origins=self.origins,
        )
        self.notice = WaitingNotice(lambda line: self.browser.show_status(escape(line)))

    @property
    def has_tool(self) -> bool:
        """True if a tool is tracked."""
        return self.painter.tool is not None

    def close(self) -> None:
        """Stop the page and its notice thread."""
        self.notice.close()
        self.browser.close()

    def play(self, video: SeekableVideo, seconds: float = np.inf) -> list[Overlay]:
        """Play a video in a loop for `seconds`; return the last overlays, without images and meshes.

        No image is skipped: if processing is slower than the video, the playback slows down. After a jump, an image is
        tracked like a first image.

        Raises
        ------
        ValueError
            The video is unreadable, or its size is not that of the calibration; the page shows the error too.
        """
        due = clock.perf_counter()
        end, known = due + seconds, None
        with self._show_failure(end):
            while (now := clock.perf_counter()) < end:
                self.browser.show_line(lambda visitor: "")
                wanted = self._find_next_number(video.count, now >= due)
                if wanted is None:
                    self._draw_in_style()
                    clock.sleep(POLL_INTERVAL)
                    continue
                self.notice.begin_work(f"processing image {wanted}")
                taken = video.read_image(wanted)
                if taken is None:
                    if video.count < 1:
                        raise ValueError(f"{video.path}: holds no image.")
                    if wanted != self.number + 1:
                        self.requested.append(video.count - 1)
                    continue
                before = known if wanted == self.number + 1 else None
                one = overlay_image(taken, None, before, self.follower, self._build_painter())
                self.notice.end_work()
                apart = 0.0 if before is None else taken.source.time - before.time
                due = now + min(max(apart, 0.0), MAX_INTERVAL)
                self.interval = min(self.interval, one.result.interval)
                known = replace(one.result, interval=self.interval)
                self._show_image(taken, one, wanted, f"image {wanted} of {video.count - 1}, {taken.source.time:.2f} s")
        return list(self.overlays)

    def _find_next_number(self, count: int, is_due: bool) -> int | None:
        """Return the number of the next image to show; None if the shown image stays."""
        wanted, first = self.number, self.number < 0
        if self.requested:
            wanted = self.requested.pop()
        elif first or (self.plays and is_due):
            wanted = (self.number + 1) % max(count, 1)
        return None if wanted == self.number else wanted

    def watch(self, images: Iterator[NamedImage | None], seconds: float = np.inf) -> list[Overlay]:
        """Show a camera's images for `seconds` or until the camera ends; a None in `images` is a missing image.

        Returns the last overlays, without images and meshes. An outdated image is dimmed, and marked as old.

        Raises
        ------
        ValueError
            The images' size is not that of the calibration; the page shows the error too.
        """
        came = clock.perf_counter()
        end, known = came + seconds, None
        with self._show_failure(end):
            for picture in images:
                now = clock.perf_counter()
                if now >= end:
                    break
                self.browser.show_line(lambda visitor: "")
                if not self.plays:
                    self._mark_outdated("paused")
                elif picture is None:
                    self._report_silence(now - came)
                else:
                    one = overlay_image(TimedImage(picture, False), 0.0, known, self.follower, self._build_painter())
                    known, came = one.result, now
                    self.browser.show_status("")
                    self._show_image(TimedImage(picture, False), one, 0, f"live from {self.name}")
        return list(self.overlays)

    def _report_silence(self, seconds: float) -> None:
        """Report on the page that the camera has delivered no image for `seconds`."""
        if seconds < UNPLUGGED_TIME:
            self._mark_outdated(f"no image for {self.follower.settings.max_gap:g} s")
        else:
            self._mark_outdated(f"no image for {seconds:.0f} s", f"Is {self.name} plugged in? This page waits for it.")

    @contextmanager
    def _show_failure(self, deadline: float) -> Iterator[None]:
        """Show a ValueError on the page for `FAILURE_TIME`, at most until `deadline`; then raise the error again."""
        try:
            yield
        except ValueError as error:
            self.notice.end_work()
            self._mark_outdated(str(error))
            clock.sleep(min(FAILURE_TIME, max(0.0, deadline - clock.perf_counter())))
            raise

    def _build_painter(self) -> Painter:
        """Return the painter with the overlay style that the user selected."""
        return replace(self.painter, style=self.style)

    def _show_image(self, source: TimedImage, overlay: Overlay, number: int, image_name: str) -> None:
        """Show an image with its report, and record its values for the charts."""
        before = self.number
        self.source, self.newest, self.number, self.image_name = source, overlay, number, image_name
        self.overlays.append(overlay.drop_mesh())
        now = clock.monotonic()
        if number not in (before, before + 1):
            self.history.interrupt_lines(now)
        self.history.add(build_history_sample(overlay.result, self._measure_gauge(overlay.result), self.has_tool, now))
        self._draw_overlay(overlay)

    def _measure_gauge(self, tracking: TrackingResult) -> DistanceGauge | None:
        """Measure the distance from tip to tumour; None if the tumour is not drawn in colour."""
        if tracking.state in GREY_STATES:
            return None
        return self.painter.measure_tip_distance(tracking, self.painter.stage.build_tumour(tracking.motion.positions))

    def _draw_overlay(self, overlay: Overlay) -> None:
        """Show an overlay's image, text, 3-D surfaces, slices and chart on the page."""
        known, look, painter = overlay.result, self.through, self.painter
        self.drawn_style = self.style, self.through
        said = format_report(overlay, self._measure_gauge(known), self.has_tool, self.image_name)
        self.browser.show(max(self.number, 0), overlay.image, said)
        self.browser.move("tumour", painter.stage.build_tumour(known.motion.positions).vertices)
        grey = known.state in GREY_STATES
        self._set_tint("tumour", STALE_COLOUR if grey else TUMOUR_COLOUR if known.is_reliable else DOUBTFUL_COLOUR)
        tool = painter.build_tool_layer(known, with_cube=False)
        if tool is not None:
            self.browser.move("tool", tool.vertices)
        if self.has_tool:
            self._set_tint("tool", STALE_COLOUR if grey or tool is None else TOOL_COLOUR)
        self.browser.show_side_panels(lambda: (render_slices(known, painter, look), self.history.draw_chart()))

    def _set_tint(self, name: str, colour: tuple[float, float, float]) -> None:
        if self.tints.get(name) != colour:
            self.tints[name] = colour
            self.browser.tint(name, colour)

    def _draw_in_style(self) -> None:
        """Draw the newest image again if the user has selected another style or slice position."""
        if self.newest is None or self.source is None or self.drawn_style == (self.style, self.through):
            return
        assert self.source.source.colour is not None
        colour = self._build_painter().paint(self.source.source.colour, self.newest.result).colour
        self.newest = replace(self.newest, image=colour)
        self._draw_overlay(self.newest)

    def _mark_outdated(self, reason: str, hint: str = "") -> None:
        """Mark the last image as old for a `reason`, unless it is already marked so."""
        said = f"{reason}: what is shown is old"
        if self.drawn_style == (said, self.style, self.through):
            return
        self.browser.show_status(escape(said))
        if self.newest is None or self.source is None:
            self.browser.report(f'<p class="warn">{escape(reason)}</p><p>{escape(hint)}</p>')
        else:
            assert self.source.source.colour is not None
            known = replace(self.newest.result, state=TumourState.STALE, warning=said)
            dim = (FADED_BRIGHTNESS * self.source.source.colour).astype(np.uint8)
            self.image_name = f"{hint} The last image" if hint else "the last image"
            self._draw_overlay(
                replace(self.newest, result=known, image=self._build_painter().paint(dim, known).colour, latency=None)
            )
        self.drawn_style = said, self.style, self.through
