"""What a camera sees now, with the tumour in it, on a page in the browser."""

from __future__ import annotations

import time as clock
from collections.abc import Iterator
from dataclasses import dataclass, field
from html import escape

import numpy as np

from ar.page.browser import Browser
from ar.page.parts import Body, Playback
from ar.tracking.pictures import Named

from ..page.view import signs_of, viewpoint_of
from ..stage import CORTEX_COLOUR, TUMOUR_COLOUR
from .follower import GAP, Follower, Known
from .picture import Painter, head_lines
from .run import Shown, Timed, overlaid_one

TITLE = "sulcus: camera"
# Of a picture's brightness, what is left of one that is old; how long its page stays when the camera is gone [s].
FADED, STAYS = 0.35, 2.0


@dataclass(eq=False)
class OverlayPage:
    """The page of one camera.

    Parameters
    ----------
    follower, painter
        What looks at its pictures, and draws into them.
    host, port
        Where it is served.
    """

    follower: Follower
    painter: Painter
    host: str = "127.0.0.1"
    port: int = 8080
    browser: Browser = field(init=False)
    plays: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        """Open the page; errors as of `ar.page.browser.Browser`."""
        stage, calibration = self.painter.stage, self.follower.calibration
        brain, tumour = stage.brain, stage.tumour_at_rest
        cortex = stage.cortex(stage.anatomy.mesh.nodes)
        bodies = [
            Body("brain", brain.vertices, brain.triangles, (0.80, 0.62, 0.58), opacity=0.25),
            Body("cortex", cortex.vertices, cortex.triangles, CORTEX_COLOUR, opacity=0.4),
            Body("tumour", tumour.vertices, tumour.triangles, TUMOUR_COLOUR),
        ]
        self.browser = Browser(
            bodies,
            viewpoint_of(stage.site),
            Playback(1, self._played, lambda number: None),
            title=TITLE,
            host=self.host,
            port=self.port,
            size=(calibration.width, calibration.height),
            signs=signs_of(stage.site),
        )

    def _played(self, playing: bool) -> None:
        self.plays = playing

    def run(self, pictures: Iterator[Named | None], seconds: float = np.inf) -> list[Shown]:
        """Show pictures until they end, or the time is over; None stands for none that came.

        Returns what was shown, without colours. What is no longer the view is dimmed, and said to be old.

        Raises
        ------
        ValueError
            What the camera raised, as where it is unplugged; the page says it, too.
        """
        known: Known | None = None
        shown: list[Shown] = []
        last: np.ndarray | None = None
        end = clock.perf_counter() + seconds
        try:
            for picture in pictures:
                if clock.perf_counter() >= end:
                    break
                if picture is None or not self.plays:
                    self._fade(last, "paused" if not self.plays else f"no picture for {GAP:g} s")
                    continue
                one = overlaid_one(Timed(picture, False), 0.0, known, self.follower, self.painter)
                known, last = one.known, one.colour
                shown.append(Shown(one.known, one.colour[:0], one.seconds, one.latency))
                self.browser.status("")
                self.browser.show(len(shown), one.colour, words(one))
                vertices = self.painter.stage.tumour(known.motion.positions).vertices
                self.browser.move("tumour", vertices)
        except ValueError as error:
            self._fade(last, str(error))
            clock.sleep(min(STAYS, max(0.0, end - clock.perf_counter())))
            raise
        return shown

    def _fade(self, last: np.ndarray | None, why: str) -> None:
        """Show that the last picture is old."""
        said = f"{why}: what is shown is old"
        self.browser.status(escape(said))
        if last is not None:
            self.browser.show(0, (FADED * last).astype(np.uint8), f'<p class="stale">{escape(said)}</p>')


def words(shown: Shown) -> str:
    """What is said beside a picture, HTML."""
    known = shown.known
    said = [known.words or known.state.value, *head_lines(known)]
    if shown.latency is not None:
        said.append(f"shown {1e3 * shown.latency:.0f} ms after it was taken")
    return "".join(f"<p>{escape(line)}</p>" for line in said)
