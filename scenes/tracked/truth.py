"""Ground truth of a video, and errors of overlays: outline, tumour position, and coverage of the error band."""

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_erosion, distance_transform_edt

from ar.optics.calibration import Calibration
from ar.overlay.outlines import compute_iou, compute_silhouette
from sim.errors import InputError
from sim.runtime.atomic_files import write_atomically
from sim.runtime.file_limits import MAX_TRUTH_BYTES
from sim.runtime.outside_files import to_path, wrap_errors
from surrogate.model.npz_archive import Archive

from ..play.stage import Stage
from .follower import TrackingResult

FORMAT = "sulcus film 1"  # Name and version of the file format.
REMEDY = "Give the truth.npz that `sulcus film` wrote."  # Remedy in error messages.
POSE_ARRAYS = ("T_camera_scan", "T_scan_tool")  # Arrays of poses.
SPACES = {"scan": "RAS [m]", "camera": "x right, y down, z forward [m]"}  # Axes and unit of the coordinate systems.
ERROR_TOLERANCE = 1e-3  # Excess of the error over its bound above which a tumour position counts as wrong [m].


@dataclass(frozen=True, eq=False)
class VideoGroundTruth:
    """Ground truth of the F images of a video.

    Parameters
    ----------
    anatomy
        Digest of the anatomy that the video shows.
    times
        Times (F,) [s].
    T_camera_scan, T_scan_tool
        Poses (F, 4, 4) [m].
    displacement
        Displacements (F, n, 3) [m] of the tumour's surface vertices, which are sorted by mesh vertex number.
    """

    anatomy: str
    times: np.ndarray
    T_camera_scan: np.ndarray
    T_scan_tool: np.ndarray
    displacement: np.ndarray

    def find_image(self, time: float) -> int | None:
        """Return the number of the image within 1 ms of a time [s]; None if there is no such image."""
        near = int(np.abs(self.times - time).argmin())
        return near if abs(self.times[near] - time) < 1e-3 else None


def write_truth(path: Path, ground_truth: VideoGroundTruth) -> None:
    """Write the ground truth as an .npz file, atomically."""
    with write_atomically(path, ".npz") as partial, partial.open("wb") as file:
        np.savez_compressed(
            file,
            header=np.array(json.dumps({"format": FORMAT, "anatomy": ground_truth.anatomy, "spaces": SPACES})),
            times=ground_truth.times,
            T_camera_scan=ground_truth.T_camera_scan,
            T_scan_tool=ground_truth.T_scan_tool,
            displacement=ground_truth.displacement.astype(np.float32),
        )


def read_truth(path: str | Path, digest: str, vertex_count: int, max_bytes: int = MAX_TRUTH_BYTES) -> VideoGroundTruth:
    """Read the ground truth for an anatomy with this digest, and with `vertex_count` vertices on the tumour's surface.

    `max_bytes` is the largest allowed size of the uncompressed arrays [bytes].

    Raises
    ------
    InputError
        The file is missing or invalid, or contains the ground truth of another anatomy.
    """
    path = to_path(path)
    with wrap_errors(path, "the ground truth of a video", REMEDY), path.open("rb") as raw:
        archive = Archive(raw, REMEDY, max_bytes)
        header = json.loads(archive.read_text("header"))
        if header["format"] != FORMAT:
            raise InputError(f"its format is not {FORMAT!r}. {REMEDY}")
        if header["anatomy"] != digest:
            raise InputError("is of another anatomy: give the one in the video, by --anatomy.")
        arrays = archive.read_arrays(("times", "displacement", *POSE_ARRAYS))
        times, moved, cameras, tools = (arrays[name].astype(float) for name in ("times", "displacement", *POSE_ARRAYS))
    count = len(times)
    shapes = (times.shape, cameras.shape, tools.shape, moved.shape)
    if not count or shapes != ((count,), (count, 4, 4), (count, 4, 4), (count, vertex_count, 3)):
        raise InputError(f"{path}: has arrays of other shapes. {REMEDY}")
    if not all(np.isfinite(each).all() for each in (times, cameras, tools, moved)):
        raise InputError(f"{path}: has numbers that are not finite. {REMEDY}")
    return VideoGroundTruth(str(header["anatomy"]), times, cameras, tools, moved)


def write_truth_table(path: Path, truth: VideoGroundTruth, rest_surface: np.ndarray) -> None:
    """Write the ground truth as a CSV table, one row per image; `rest_surface` (n, 3) [m]: undeformed tumour surface.

    A pose has 12 columns, the upper three rows of the matrix from scan to camera, or from tool to scan [mm].
    """
    names = [f"{what}_{row}{column}" for what in POSE_ARRAYS for row in range(3) for column in range(4)]
    with write_atomically(path, ".csv") as partial, partial.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(("time_s", "tumour_x_mm", "tumour_y_mm", "tumour_z_mm", "moved_mm", *names, "space"))
        for number, time in enumerate(truth.times):
            moved = truth.displacement[number]
            middle = 1e3 * (rest_surface + moved).mean(axis=0)
            poses = np.stack([truth.T_camera_scan[number], truth.T_scan_tool[number]])[:, :3] * [1.0, 1.0, 1.0, 1e3]
            mean = 1e3 * float(np.linalg.norm(moved, axis=1).mean())
            table.writerow((f"{time:.6f}", *(f"{each:.5f}" for each in (*middle, mean, *poses.ravel())), "RAS"))


@dataclass(frozen=True)
class OverlayError:
    """Error of one overlay relative to the ground truth.

    Parameters
    ----------
    outline, overlap
        Mean distance between the drawn and the true outline [pixel]; intersection over union of the silhouettes.
    centroid, maximum
        Error of the tumour's centroid and maximum error on its surface, across the true line of sight [m].
    is_covered
        True if `maximum` is within the error band of the overlay.
    """

    outline: float
    overlap: float
    centroid: float
    maximum: float
    is_covered: bool


def compute_overlay_error(
    tracking: TrackingResult, ground_truth: VideoGroundTruth, calibration: Calibration, stage: Stage
) -> OverlayError | None:
    """Compute the error of a tracking result; None if it has no camera pose or no ground truth at its time."""
    row = ground_truth.find_image(tracking.time)
    if row is None or tracking.camera is None:
        return None
    camera, triangles = calibration.build_camera(ground_truth.T_camera_scan[row]), stage.tumour_at_rest.triangles
    true = stage.tumour_at_rest.vertices + ground_truth.displacement[row]
    here = tracking.motion.positions[stage.tumour_vertices]
    masks = compute_silhouette(camera, true, triangles), compute_silhouette(tracking.camera, here, triangles)
    seen, apart = camera.to_camera_frame(true), tracking.camera.to_camera_frame(here) - camera.to_camera_frame(true)
    across = _compute_lateral_lengths(apart, seen)
    middle = float(_compute_lateral_lengths(apart.mean(axis=0)[None], seen.mean(axis=0)[None])[0])
    return OverlayError(
        _compute_edge_distance(*masks),
        compute_iou(*masks),
        middle,
        float(across.max()),
        tracking.bound is not None and across.max() <= tracking.bound,
    )


def _compute_lateral_lengths(vectors: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Compute lengths (n,) of vectors (n, 3) across the lines of sight to points (n, 3) in camera coordinates."""
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    return np.linalg.norm(vectors - np.sum(vectors * rays, axis=1, keepdims=True) * rays, axis=1)


def _compute_edge_distance(true_mask: np.ndarray, drawn_mask: np.ndarray) -> float:
    """Compute the mean distance [pixel] between the edges of two masks; infinite if a mask is empty."""
    edges = [mask & (np.asarray(binary_erosion(mask)) == 0) for mask in (true_mask, drawn_mask)]
    if not all(edge.any() for edge in edges):
        return np.inf
    there, back = (np.asarray(distance_transform_edt(edge == 0)) for edge in edges)
    return float(max(there[edges[1]].mean(), back[edges[0]].mean()))


def summarise_errors(results: Sequence[TrackingResult], errors: Sequence[OverlayError | None]) -> dict[str, object]:
    """Compute medians and 95th percentiles over reliable overlays, and the number of overlays beyond their bound."""
    relied = [(each, error) for each, error in zip(results, errors, strict=True) if each.is_reliable and error]
    if not relied:
        return {"pictures": 0}
    rows = [error for _, error in relied]
    wrong = [each for each, error in relied if error.maximum > (each.bound or 0.0) + ERROR_TOLERANCE]
    return {
        "pictures": len(rows),
        **_compute_percentiles("outline_px", [row.outline for row in rows]),
        "overlap_p50": float(np.median([row.overlap for row in rows])),
        "overlap_least": min(row.overlap for row in rows),
        **_compute_percentiles("middle_mm", [1e3 * row.centroid for row in rows]),
        **_compute_percentiles("worst_mm", [1e3 * row.maximum for row in rows]),
        **_compute_percentiles("band_mm", [1e3 * (each.bound or 0.0) for each, _ in relied]),
        "held_percent": 100.0 * float(np.mean([row.is_covered for row in rows])),
        "wrong": len(wrong),
    }


def _compute_percentiles(name: str, values: Sequence[float]) -> dict[str, float]:
    return {f"{name}_p50": float(np.median(values)), f"{name}_p95": float(np.percentile(values, 95.0))}
