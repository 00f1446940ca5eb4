"""Loop over real images that tracks, computes the brain's motion and draws the overlay, with its latency."""

from __future__ import annotations

import csv
import time as clock
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from ar.tracking.image_sequences import NamedImage
from ar.tracking.pose_stream import DAY_SECONDS
from ar.tracking.synthetic_images import read_time_stamp
from sim.runtime.atomic_files import write_atomically

from .follower import Follower, TrackingResult, TumourState
from .overlay_painter import Painter
from .truth import OverlayError

LATENCY_EDGES = (0, 20, 40, 60, 80, 100, 150, 200, 300, 500, 1000)  # Edges of the histogram of latencies [ms].
STALE_AGE = 0.2  # Age at which an image is stale [s].
# Smallest grey level of an occluder in a mask video, where black is not exactly 0; in a mask PNG it is 1.
MIN_OCCLUDER_GREY = 32
# Column names of the table of results.
COLUMNS = (
    "time_s", "state", "tumour_x_mm", "tumour_y_mm", "tumour_z_mm", "moved_mm", "motion_off_mm", "within_mm",
    "tracking_mm", "camera_mm", "registration_mm", "tool_mm", "model_mm", "shutter_mm", "ms", "latency_ms", "words",
    "outline_px", "overlap", "middle_off_mm", "worst_off_mm", "space",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Overlay:
    """Image with its overlay.

    Parameters
    ----------
    result
        Tracking result that is drawn.
    image
        Image (H, W, 3) uint8 with the overlay.
    seconds
        Processing time from the image's arrival [s].
    centroid
        Centroid (3,) [m] of the drawn tumour, in the scan.
    latency
        Time from the image's acquisition to its overlay [s]; None if the images are not live.
    has_stamp
        True if the time was read from a time stamp in the image's pixels.
    """

    result: TrackingResult
    image: np.ndarray
    seconds: float
    centroid: np.ndarray
    latency: float | None = None
    has_stamp: bool = False

    def drop_image(self) -> Overlay:
        """Return the overlay with an empty image, to save memory."""
        return replace(self, image=np.empty((0, 0, 3), np.uint8))

    def drop_mesh(self) -> Overlay:
        """Return the overlay without the brain's vertex positions and with an empty image, to save memory."""
        motion = replace(self.result.motion, positions=np.empty((0, 3)), solution=None)
        return replace(self.drop_image(), result=replace(self.result, motion=motion))


@dataclass(frozen=True, eq=False)
class TimedImage:
    """Image with its time [s], which is read from a time stamp in the pixels if present, else from the source.

    `occluded` (H, W) bool is the mask of foreground in front of the brain, such as a hand; None without a mask.
    """

    source: NamedImage
    has_stamp: bool
    occluded: np.ndarray | None = None


def read_timed_images(images: Iterator[NamedImage], masks: Iterator[NamedImage] | None = None) -> Iterator[TimedImage]:
    """Yield images with their times and foreground masks; pixels of a mask that are not black are foreground.

    Times continue after midnight if a 24-hour clock restarts.

    Raises
    ------
    ValueError
        An image has no mask, a mask has no image, or the sizes of a mask and its image differ.
    """
    before, days = -np.inf, 0.0
    for number, picture in enumerate(images):
        covered = None if masks is None else _get_mask(masks, picture, number)
        stamp = read_time_stamp(picture.grey)
        time = days + (picture.time if stamp is None else stamp)
        if time < before - 0.5 * DAY_SECONDS:
            time, days = time + DAY_SECONDS, days + DAY_SECONDS
        before = time
        yield TimedImage(replace(picture, time=time), stamp is not None, covered)
    if masks is not None and next(masks, None) is not None:
        raise ValueError("there are more masks than images. Give one for each image, in order.")


def _get_mask(masks: Iterator[NamedImage], image: NamedImage, number: int) -> np.ndarray:
    """Return the foreground mask (H, W) bool of image `number`."""
    mask = next(masks, None)
    if mask is None:
        raise ValueError(f"{image.name} has no mask: there are {number}. Give one for each image, in order.")
    if mask.grey.shape != image.grey.shape:
        raise ValueError(f"the mask {mask.name} is {mask.grey.shape}, its image {image.grey.shape}.")
    return mask.grey >= (1 if mask.name.lower().endswith(".png") else MIN_OCCLUDER_GREY)


def pace_images(images: Iterator[TimedImage]) -> Iterator[tuple[TimedImage, float]]:
    """Yield images as a live camera would: at each request the newest image, with the clock time [s] of image time 0.

    Older images that arrive between two requests are dropped.
    """
    waiting = next(images, None)
    if waiting is None:
        return
    begun = clock.perf_counter() - waiting.source.time
    while waiting is not None:
        newer = next(images, None)
        while newer is not None and newer.source.time <= clock.perf_counter() - begun:
            waiting, newer = newer, next(images, None)
        clock.sleep(max(0.0, waiting.source.time - (clock.perf_counter() - begun)))
        yield waiting, begun
        waiting = newer


def draw_overlays(
    images: Iterator[TimedImage], follower: Follower, painter: Painter, is_live: bool = False
) -> Iterator[Overlay]:
    """Yield the overlay of each image; if `is_live`, in real time: late images are skipped, and old images are marked.

    Raises
    ------
    ValueError
        See `Follower.step`; also errors of the video reader.
    """
    known: TrackingResult | None = None
    for taken, begun in pace_images(images) if is_live else ((each, None) for each in images):
        shown = overlay_image(taken, begun, known, follower, painter)
        known = shown.result
        yield shown


def overlay_image(
    image: TimedImage, start_time: float | None, previous: TrackingResult | None, follower: Follower, painter: Painter
) -> Overlay:
    """Compute the overlay of one image; `previous` is the tracking result of the previous image.

    `start_time` is the clock time [s] of image time 0 for live images, of which old ones are marked stale; else None.

    Raises
    ------
    ValueError
        See `Follower.step`.
    """
    arrived, picture = clock.perf_counter(), image.source
    assert picture.colour is not None
    known = follower.track(picture.grey, picture.time, previous)
    drawn = known if start_time is None else mark_stale(known, clock.perf_counter() - start_time - picture.time)
    colour = painter.paint(picture.colour, drawn, image.occluded).colour
    ready = clock.perf_counter()
    latency = None if start_time is None else ready - start_time - picture.time
    middle = drawn.motion.positions[painter.stage.tumour_vertices].mean(axis=0)
    return Overlay(drawn, colour, ready - arrived, middle, latency, image.has_stamp)


def mark_stale(tracking: TrackingResult, age: float) -> TrackingResult:
    """Return a tracking result, marked as stale if the image's age [s] exceeds `STALE_AGE`."""
    if age <= STALE_AGE or not tracking.is_reliable:
        return tracking
    return replace(tracking, state=TumourState.STALE, warning=f"stale, the image is {age:.1f} s old: do not rely on it")


def summarise_latencies(overlays: list[Overlay]) -> dict[str, object]:
    """Compute median, 95th percentile and histogram [ms] of live images' latencies, or else of processing times."""
    live = [each.latency for each in overlays if each.latency is not None]
    milliseconds = 1e3 * np.array(live or [each.seconds for each in overlays])
    counts = np.histogram(milliseconds, [*LATENCY_EDGES, np.inf])[0]
    names = [*(f"{low}-{high}" for low, high in pairwise(LATENCY_EDGES)), f"over {LATENCY_EDGES[-1]}"]
    return {
        "what": "from the image's time to its overlay" if live else "from the image's arrival to its overlay",
        "time_from": "pixels" if all(each.has_stamp for each in overlays) else "the source",
        "p50_ms": float(np.median(milliseconds)),
        "p95_ms": float(np.percentile(milliseconds, 95.0)),
        "histogram_ms": {name: int(count) for name, count in zip(names, counts, strict=True) if count},
    }


def write_tracking_table(path: Path, overlays: Sequence[Overlay], errors: Sequence[OverlayError | None]) -> None:
    """Write a CSV file with a row for each image, atomically; cells without a value are blank.

    The position is the tumour's centroid in the scan (RAS). `within_mm` is the 95 % error bound across the line of
    sight. Four columns contain the errors relative to the ground truth, if available. The last column names the
    coordinate system.
    """
    with write_atomically(path, ".csv") as partial, partial.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        table.writerows(_format_row(each, error) for each, error in zip(overlays, errors, strict=True))


def _format_row(overlay: Overlay, error: OverlayError | None) -> list[str]:
    known = overlay.result
    placed = known.camera is not None
    lengths: list[float | None] = [*overlay.centroid, known.motion.distance if known.motion.supported else None]
    lengths.append(known.motion.error if known.motion.supported else None)
    lengths += [
        known.bound,
        *(known.sources.get(name) for name in ("tracking", "camera", "registration", "tool", "model", "shutter")),
    ]
    cells = [_format_number(None if value is None or not placed else 1e3 * value) for value in lengths]
    late = None if overlay.latency is None else 1e3 * overlay.latency
    against = (None,) * 4
    if error is not None:
        against = error.outline, error.overlap, 1e3 * error.centroid, 1e3 * error.maximum
    return [
        f"{known.time:.6f}", known.state.name.lower(), *cells, f"{1e3 * overlay.seconds:.1f}", _format_number(late, 1),
        known.warning, *(_format_number(value, 3) for value in against), "RAS",
    ]  # fmt: skip


def _format_number(value: float | None, digits: int = 4) -> str:
    return "" if value is None else f"{value:.{digits}f}"
