"""Verification of an overlay by the pixels of its images, with lost and recovered markers and late images."""

import time as clock
from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np

from ar.overlay.composite import HIDDEN_STROKES, WARNING_COLOUR, format_warning
from ar.overlay.hud import TEXT_SCALE, WHITE
from ar.overlay.outlines import average_colour, compute_silhouette, find_colour, has_text, measure_outline_distance
from ar.overlay.styles import Style

from ..play.image_checks import SOFT_LENGTH
from ..play.stage import TUMOUR_COLOUR
from .filming import VideoFrame, register_with_error
from .follower import Follower, TrackingResult
from .overlay_painter import Painter
from .rendered_video import RenderedVideo
from .run import STALE_AGE, TimedImage, overlay_image
from .tool_motion import ToolMotion

LOST_TEXTS = {"reference": "reference lost", "tool": "tool lost"}  # Text required in an image, by covered target.
STALE_TEXT = "stale"  # Text required in a stale image.


@dataclass(frozen=True)
class TrackingCheckSettings:
    """Settings of `measure_tracking`, and limits of its figures."""

    # Maximum number of images until a returned target is found: lost ones are searched in every third image.
    max_search_images: int = 3
    max_outline_error: float = 2.0  # Maximum error of a drawn outline [pixel].
    min_line_pixels: int = 5  # Number of pixels of an outline's colour below which there is no line.
    repeated_time: float = 0.1  # Time of the repeated image [s].
    delayed_time: float = 0.2  # Time of the delayed image [s].
    image_delay: float = 2.5 * STALE_AGE  # Delay of the delayed image [s].


CHECK = TrackingCheckSettings()


@dataclass(frozen=True)
class TrackingFigures:
    """Worst metrics over the overlays of a video.

    Parameters
    ----------
    pictures
        Number of images.
    confident
        Number of images in which a lost or old position is drawn in the colour of a reliable position.
    unsaid
        Number of images with a lost or old position that do not show the reason as text.
    back
        Largest number of images until the tumour is drawn as reliable, at the video's start or after a disturbance;
        infinite: never.
    off
        Largest distance between a drawn reliable outline and the true outline [pixel].
    """

    pictures: int
    confident: int
    unsaid: int
    back: float
    off: float

    def find_violations(self) -> list[str]:
        """Return a sentence for each metric that exceeds its limit."""
        back, near = self.back <= CHECK.max_search_images, self.off <= CHECK.max_outline_error
        rules = {
            f"{self.confident} images draw a lost or old position as if it were known": self.confident == 0,
            f"{self.unsaid} images do not say that something is lost or old": self.unsaid == 0,
            f"the tumour is back after {self.back:g} images, more than {CHECK.max_search_images}": back,
            f"a place drawn as known is {self.off:.1f} pixels off, more than {CHECK.max_outline_error:g}": near,
        }
        return [sentence for sentence, kept in rules.items() if not kept]

    def to_row(self) -> dict[str, float | None]:
        """Convert the metrics to a JSON object; infinite values become None."""
        return {name: value if np.isfinite(value) else None for name, value in asdict(self).items()}


@dataclass(frozen=True, eq=False)
class ArrivingImage:
    """Image at its arrival, with its age [s], and the text that its overlay must show (empty: no disturbance)."""

    frame: VideoFrame
    age: float = 0.0
    required_text: str = ""


def replay_images(video: RenderedVideo) -> Iterator[ArrivingImage]:
    """Yield the images of a video in order; one image is repeated, one is delayed, and one follows a gap."""
    before = 0.0
    for shot in video.frames:
        covered = video.degradation.list_disturbances(shot.time)
        words = next((LOST_TEXTS[kind] for kind in LOST_TEXTS if kind in covered), "")
        if shot.time - before > STALE_AGE:
            words = STALE_TEXT
        late = CHECK.image_delay if np.isclose(shot.time, CHECK.delayed_time) else 0.0
        yield ArrivingImage(shot, late, STALE_TEXT if late else words)
        if np.isclose(shot.time, CHECK.repeated_time):
            yield ArrivingImage(shot, required_text=STALE_TEXT)
        before = shot.time


def build_default_pipeline(video: RenderedVideo, style: Style = "window") -> tuple[Follower, Painter]:
    """Build the default follower and painter for a video, with exact registration."""
    mounts, stage = video.targets, video.stage
    exact = register_with_error(stage.site, mounts, 0.0, 0.0, 0)
    follower = Follower(video.calibration, exact, mounts.tool, ToolMotion(stage, video.deformer))
    return follower, Painter(stage, mounts.tool, style, stage.device)


def measure_tracking(video: RenderedVideo, follower: Follower, painter: Painter) -> TrackingFigures:
    """Track a video, draw the overlays, and measure the metrics in the pixels of the overlays."""
    known: TrackingResult | None = None
    confident, unsaid, waits, worst, waiting, count = 0, 0, [0], 0.0, True, 0
    for event in replay_images(video):
        count += 1
        begun = clock.perf_counter() - event.frame.time - event.age if event.age else None
        shown = overlay_image(TimedImage(video.get_image(event.frame), True), begun, known, follower, painter)
        known = shown.result
        drawn = bool(np.count_nonzero(find_colour(shown.image, average_colour(TUMOUR_COLOUR))) >= CHECK.min_line_pixels)
        if event.required_text:
            confident += drawn
            unsaid += not _has_warning(shown.image, known.warning, event.required_text)
            waits += [] if waiting else [0]
            waiting = True
            continue
        if waiting:
            waits[-1] += 1
        waiting = waiting and not drawn
        if drawn:
            worst = max(worst, _measure_outline_error(video, event.frame, shown.image))
    return TrackingFigures(count, confident, unsaid, np.inf if waiting else max(waits), worst)


def _has_warning(colour: np.ndarray, text: str, prefix: str) -> bool:
    """Return True if `text` begins with `prefix`, and the image shows this text as a warning."""
    lines = format_warning(text, colour.shape[1])
    return text.startswith(prefix) and all(
        has_text(colour, line, TEXT_SCALE, average_colour(WARNING_COLOUR)) for line in lines
    )


def _measure_outline_error(video: RenderedVideo, frame: VideoFrame, colour: np.ndarray) -> float:
    """Compute the distance [pixel] between the outline in an image and the true outline of the tumour."""
    camera, rest = video.calibration.build_camera(frame.T_camera_scan), video.stage.tumour_at_rest
    mask = compute_silhouette(camera, rest.vertices + frame.displacement, rest.triangles)
    tool = compute_silhouette(camera, *video.targets.tool.build_surface(frame.T_scan_tool))
    words = find_colour(colour, WHITE, 0)
    return measure_outline_distance(
        colour, average_colour(TUMOUR_COLOUR), mask, tool | words, gap_length=HIDDEN_STROKES[1] + SOFT_LENGTH
    )
