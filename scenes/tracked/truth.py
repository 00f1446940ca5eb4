"""Overlays held against what is true of a film: how far off outline and tumour are, and whether the band holds them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_erosion, distance_transform_edt

from ar.optics.calibration import Calibration
from ar.overlay.outlines import iou, silhouette

from ..play.stage import Stage
from .film_truth import Truth
from .follower import Known

# Beyond its band by more than this a tumour is wrong [m].
WRONG = 1e-3


@dataclass(frozen=True)
class Off:
    """How far off one overlay is.

    Parameters
    ----------
    outline, overlap
        Mean distance of the drawn outline from the true one [pixel]; intersection over union of the silhouettes.
    middle, worst
        Of the tumour's middle, and of its worst surface point, across the true line of sight [m].
    held
        Whether the worst is within the band.
    """

    outline: float
    overlap: float
    middle: float
    worst: float
    held: bool


def off(known: Known, truth: Truth, calibration: Calibration, stage: Stage) -> Off | None:
    """How far off what is known of a picture is; None where no place is drawn, or nothing is true of its time."""
    row = truth.at(known.time)
    if row is None or known.camera is None:
        return None
    camera, triangles = calibration.camera(truth.T_camera_scan[row]), stage.tumour_at_rest.triangles
    true = stage.tumour_at_rest.vertices + truth.displacement[row]
    here = known.motion.positions[stage.tumour_vertices]
    masks = silhouette(camera, true, triangles), silhouette(known.camera, here, triangles)
    seen, apart = camera.in_frame(true), known.camera.in_frame(here) - camera.in_frame(true)
    across = _across(apart, seen)
    middle = float(_across(apart.mean(axis=0)[None], seen.mean(axis=0)[None])[0])
    return Off(
        _between(*masks),
        iou(*masks),
        middle,
        float(across.max()),
        known.band is not None and across.max() <= known.band,
    )


def _across(apart: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Lengths (n,) of vectors (n, 3) across the lines of sight to points (n, 3) of the camera's frame."""
    rays = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    return np.linalg.norm(apart - np.sum(apart * rays, axis=1, keepdims=True) * rays, axis=1)


def _between(true: np.ndarray, drawn: np.ndarray) -> float:
    """Mean distance [pixel] of the edge of a mask from that of the true one, and back; infinite without either."""
    edges = [mask & (np.asarray(binary_erosion(mask)) == 0) for mask in (true, drawn)]
    if not all(edge.any() for edge in edges):
        return np.inf
    there, back = (np.asarray(distance_transform_edt(edge == 0)) for edge in edges)
    return float(max(there[edges[1]].mean(), back[edges[0]].mean()))


def summary(known: Sequence[Known], errors: Sequence[Off | None]) -> dict[str, object]:
    """Medians and 95th percentiles over the pictures whose tumour is drawn as known; how many of these are wrong."""
    relied = [(each, error) for each, error in zip(known, errors, strict=True) if each.relied and error is not None]
    if not relied:
        return {"pictures": 0}
    rows = [error for _, error in relied]
    wrong = [each for each, error in relied if error.worst > (each.band or 0.0) + WRONG]
    return {
        "pictures": len(rows),
        **_two("outline_px", [row.outline for row in rows]),
        "overlap_p50": float(np.median([row.overlap for row in rows])),
        "overlap_least": min(row.overlap for row in rows),
        **_two("middle_mm", [1e3 * row.middle for row in rows]),
        **_two("worst_mm", [1e3 * row.worst for row in rows]),
        **_two("band_mm", [1e3 * (each.band or 0.0) for each, _ in relied]),
        "held_percent": 100.0 * float(np.mean([row.held for row in rows])),
        "wrong": len(wrong),
    }


def _two(name: str, values: Sequence[float]) -> dict[str, float]:
    return {f"{name}_p50": float(np.median(values)), f"{name}_p95": float(np.percentile(values, 95.0))}
