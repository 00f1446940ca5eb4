"""Page of a video, or of a live camera, with the tumour overlay."""

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

from ..page.controls import add_overlay_controls, build_slice_control
from ..page.view import STALE_COLOUR, build_brain, choose_viewpoint, list_orientation_labels
from ..play.stage import TOOL_COLOUR, TUMOUR_COLOUR
from ..play.waiting_notice import Busy
from .follower import MAX_INTERVAL, Follower, TrackingResult, TumourState
from .overlay_painter import GREY_STATES, Painter
from .overlay_panels import build_history_sample, list_lines, render_slices
from .overlay_text import describe_overlay, report
from .run import Shown, Timed, overlay_one
from .seekable_video import SeekableFilm

FADED_BRIGHTNESS = 0.35  # Brightness factor of an outdated image.
FAILURE_TIME = 2.0  # Time for which the page stays after a failure [s].
POLL_INTERVAL = 0.03  # Polling interval of an idle page [s].
UNPLUGGED_TIME = 1.0  # Time without an image after which a camera may be unplugged [s].
MAX_KEPT_RESULTS = 20_000  # Number of results kept for a table and a summary, without their colours.


@dataclass(eq=False)
class OverlayPage:
    """Page of one video, or of one camera.

    Parameters
    ----------
    follower, painter
        Tracker of its images, and overlay renderer.
    name, model
        Name of the video or the camera, and description of the deformation model.
    host, port
        Address of the server.
    frames
        Number of images of the video; 0: it is a camera.
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
    busy: Busy = field(init=False)
    history: History = field(init=False)
    shown: deque[Shown] = field(default_factory=lambda: deque(maxlen=MAX_KEPT_RESULTS), init=False)
    # Requests of users, written by the page's threads.
    plays: bool = field(default=True, init=False)
    style: Style = field(init=False)
    through: str = field(default="", init=False)
    sought: deque[int] = field(default_factory=lambda: deque(maxlen=1), init=False)
    # Displayed state: the original image, its overlay, and its style.
    taken: Timed | None = field(default=None, init=False)
    newest: Shown | None = field(default=None, init=False)
    number: int = field(default=-1, init=False)
    # Shortest interval between two images up to now [s].
    interval: float = field(default=MAX_INTERVAL, init=False)
    place: str = field(default="", init=False)
    drawn: tuple[str, ...] = field(default=(), init=False)
    tints: dict[str, tuple[float, float, float]] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        """Open the page; for errors see `ar.page.browser.Browser`."""
        stage, tool, calibration = self.painter.stage, self.painter.tool, self.follower.calibration
        self.style, self.history = self.painter.style, History(list_lines(self.tooled))
        bodies = build_brain(stage)
        if tool is not None:
            # Empty until the tool is visible.
            away = np.tile(stage.site.origin, (len(tool.bare[0]), 1))
            bodies.append(SceneSurface("tool", away, tool.bare[1], TOOL_COLOUR))
        self.browser = Browser(
            bodies,
            choose_viewpoint(stage.site),
            Playback(self.frames, lambda playing: setattr(self, "plays", playing), self.sought.append),
            [
                add_overlay_controls(self.style, lambda style: setattr(self, "style", style)),
                build_slice_control(self.through, lambda name: setattr(self, "through", name)),
            ],
            title=f"sulcus: {self.name}",
            words=describe_overlay(self.name, self.model, self.tooled),
            host=self.host,
            port=self.port,
            size=(calibration.width, calibration.height),
            signs=list_orientation_labels(stage.site),
            origins=self.origins,
        )
        self.busy = Busy(lambda line: self.browser.show_status(escape(line)))

    @property
    def tooled(self) -> bool:
        """True if a tool is tracked."""
        return self.painter.tool is not None

    def close(self) -> None:
        """Stop the page."""
        self.busy.close()
        self.browser.close()

    def play(self, film: SeekableFilm, seconds: float = np.inf) -> list[Shown]:
        """Play a video in a loop for the given time; return the last results, without colours.

        No image is skipped: if processing is slower than the video, playback slows down. An image that is not the next
        one is tracked like a first image.

        Raises
        ------
        ValueError
            An unreadable video, or one of another size than the camera's; the page reports it, too.
        """
        due = clock.perf_counter()
        end, known = due + seconds, None
        with self._show_failure(end):
            while (now := clock.perf_counter()) < end:
                self.browser.show_line(lambda visitor: "")
                wanted = self._find_next_number(film.count, now >= due)
                if wanted is None:
                    self._draw_in_style()
                    clock.sleep(POLL_INTERVAL)
                    continue
                self.busy.begin_work(f"processing image {wanted}")
                taken = film.read_image(wanted)
                if taken is None:
                    if film.count < 1:
                        raise ValueError(f"{film.path}: holds no image.")
                    if wanted != self.number + 1:
                        self.sought.append(film.count - 1)
                    continue
                before = known if wanted == self.number + 1 else None
                one = overlay_one(taken, None, before, self.follower, self._build_painter())
                self.busy.end_work()
                apart = 0.0 if before is None else taken.picture.time - before.time
                due = now + min(max(apart, 0.0), MAX_INTERVAL)
                self.interval = min(self.interval, one.known.interval)
                known = replace(one.known, interval=self.interval)
                self._show(taken, one, wanted, f"image {wanted} of {film.count - 1}, {taken.picture.time:.2f} s")
        return list(self.shown)

    def _find_next_number(self, count: int, due: bool) -> int | None:
        """Return the number of the image to be shown, if it is not the current one."""
        wanted, first = self.number, self.number < 0
        if self.sought:
            wanted = self.sought.pop()
        elif first or (self.plays and due):
            wanted = (self.number + 1) % max(count, 1)
        return None if wanted == self.number else wanted

    def watch(self, pictures: Iterator[NamedImage | None], seconds: float = np.inf) -> list[Shown]:
        """Show a camera's images until it ends, or the time is over; None stands for a missing image.

        Return the last results, without colours. An outdated image is dimmed, and marked as old.

        Raises
        ------
        ValueError
            Images of another size than the camera's; the page reports it, too.
        """
        came = clock.perf_counter()
        end, known = came + seconds, None
        with self._show_failure(end):
            for picture in pictures:
                now = clock.perf_counter()
                if now >= end:
                    break
                self.browser.show_line(lambda visitor: "")
                if not self.plays:
                    self._mark_outdated("paused")
                elif picture is None:
                    self._report_silence(now - came)
                else:
                    one = overlay_one(Timed(picture, False), 0.0, known, self.follower, self._build_painter())
                    known, came = one.known, now
                    self.browser.show_status("")
                    self._show(Timed(picture, False), one, 0, f"live from {self.name}")
        return list(self.shown)

    def _report_silence(self, seconds: float) -> None:
        """Report that a camera has given no image for `seconds`."""
        if seconds < UNPLUGGED_TIME:
            self._mark_outdated(f"no image for {self.follower.settings.max_gap:g} s")
        else:
            self._mark_outdated(f"no image for {seconds:.0f} s", f"Is {self.name} plugged in? This page waits for it.")

    @contextmanager
    def _show_failure(self, end: float) -> Iterator[None]:
        """Show the reason of a failure on the page for some time, then raise the error again."""
        try:
            yield
        except ValueError as error:
            self.busy.end_work()
            self._mark_outdated(str(error))
            clock.sleep(min(FAILURE_TIME, max(0.0, end - clock.perf_counter())))
            raise

    def _build_painter(self) -> Painter:
        """Return the painter with the requested style."""
        return replace(self.painter, style=self.style)

    def _show(self, taken: Timed, one: Shown, number: int, place: str) -> None:
        """Show an image with its report, and record its readings."""
        before = self.number
        self.taken, self.newest, self.number, self.place = taken, one, number, place
        self.shown.append(one.drop_mesh())
        now = clock.monotonic()
        if number not in (before, before + 1):
            self.history.interrupt_lines(now)
        self.history.add(build_history_sample(one.known, self._measure_gauge(one.known), self.tooled, now))
        self._draw(one)

    def _measure_gauge(self, known: TrackingResult) -> DistanceGauge | None:
        """Measure from tip to tumour; None if the tumour is drawn in grey or not at all."""
        if known.state in GREY_STATES:
            return None
        return self.painter.measure_tip(known, self.painter.stage.build_tumour(known.motion.positions))

    def _draw(self, one: Shown) -> None:
        """Show an image, its text, bodies, slices and chart on the page."""
        known, look, painter = one.known, self.through, self.painter
        self.drawn = self.style, self.through
        said = report(one, self._measure_gauge(known), self.tooled, self.place)
        self.browser.show(max(self.number, 0), one.colour, said)
        self.browser.move("tumour", painter.stage.build_tumour(known.motion.positions).vertices)
        grey = known.state in GREY_STATES
        self._set_tint("tumour", STALE_COLOUR if grey else TUMOUR_COLOUR if known.relied else DOUBTFUL_COLOUR)
        tool = painter.build_tool_layer(known, cubed=False)
        if tool is not None:
            self.browser.move("tool", tool.vertices)
        if self.tooled:
            self._set_tint("tool", STALE_COLOUR if grey or tool is None else TOOL_COLOUR)
        self.browser.show_beside(lambda: (render_slices(known, painter, look), self.history.draw_chart()))

    def _set_tint(self, name: str, colour: tuple[float, float, float]) -> None:
        if self.tints.get(name) != colour:
            self.tints[name] = colour
            self.browser.tint(name, colour)

    def _draw_in_style(self) -> None:
        """Draw the newest image in another style, if requested."""
        if self.newest is None or self.taken is None or self.drawn == (self.style, self.through):
            return
        assert self.taken.picture.colour is not None
        colour = self._build_painter().paint(self.taken.picture.colour, self.newest.known).colour
        self.newest = replace(self.newest, colour=colour)
        self._draw(self.newest)

    def _mark_outdated(self, why: str, hint: str = "") -> None:
        """Mark the last image as old, unless it is marked already."""
        said = f"{why}: what is shown is old"
        if self.drawn == (said, self.style, self.through):
            return
        self.browser.show_status(escape(said))
        if self.newest is None or self.taken is None:
            self.browser.report(f'<p class="warn">{escape(why)}</p><p>{escape(hint)}</p>')
        else:
            assert self.taken.picture.colour is not None
            known = replace(self.newest.known, state=TumourState.STALE, words=said)
            dim = (FADED_BRIGHTNESS * self.taken.picture.colour).astype(np.uint8)
            self.place = f"{hint} The last image" if hint else "the last image"
            self._draw(
                replace(self.newest, known=known, colour=self._build_painter().paint(dim, known).colour, latency=None)
            )
        self.drawn = said, self.style, self.through
