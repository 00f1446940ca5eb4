"""Verification of a scene's images: metrics of every frame, and comparison of the worst values with limits."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from ar.optics.camera import Camera, project_cv2
from ar.overlay.outlines import compute_iou, compute_silhouette
from ar.rendering.layer import Layer, compute_vertex_normals
from sim.deformation import Deformation
from surrogate.locating.prior import compute_centroid_motion

from ..script.scene import Bounds
from .image_checks import (
    has_distance_at_tip,
    has_hidden_mark,
    has_printed_numbers,
    measure_outline_error,
    measure_true_outline_error,
    render_silhouette,
)
from .player import Frame, Player
from .stage import DRAPE

# Largest distance of the visible cortex from the normal below the FEM surface, and above that surface [m].
MAX_ASIDE = 1e-9
STILL_SHARE = 0.25  # Share of its largest motion below which the tumour counts as still.
WORST_MISS = 0.0, np.inf, np.inf, np.inf, 1.0, False
"""Metrics of a tumour at an invalid position: overlap, distance [m], two image distances [pixel], occlusion drawn."""


@dataclass(frozen=True)
class SceneFigures:
    """Worst metrics over the frames of a scene.

    Parameters
    ----------
    overlap
        Smallest intersection over union of the silhouettes of the drawn tumour and of the FEM tumour, both projected
        by the camera of the scene.
    error_mm, motion_mm
        Largest mean error and largest mean displacement (by FEM) of the tumour's nodes over the frames [mm].
    pixels
        Distance between the tumour's projections by the drawing camera and by OpenCV with the scene's camera [pixel].
    drawn
        95th percentile of the distance between the outline in the image, which is detected by its colour, and the
        outline that another renderer computes [pixel].
    printed, labelled
        `printed`: the image shows the frame number and the distance from tip to tumour that is computed here.
        `labelled`: the text of this distance is completely visible near the tip.
    visible
        Smallest share of the tumour's silhouette that drape and bone leave visible.
    honest
        True if occluded parts are drawn as a broken outline without shading, and the image names the occluder.
    finite, answered
        `finite`: every number and image is finite, and the visible cortex moves with the FEM surface.
        `answered`: every drawn solution and every FEM solution has a good outcome.
    doubt
        Frame, source and outcome of the first solution with a bad outcome, and the number of other bad solutions.
    in_step
        True if every image shows the solution at its own time.
    leaked
        Volume that leaks through the closed skull in the FEM solutions, as a share of the volume exchanged at the
        craniotomy. It is reported and has no limit: see docs/verification.md.
    bond
        Largest traction between brain and skull, as a share of the bond strength: above 1 it would debond. NaN without
        bonds. It is reported and has no limit.
    covered, removed
        In a scene with an observation model: share of frames whose ellipsoid contains the true tumour centroid, and
        share of the tumour motion, summed over frames, that the estimate removes. NaN in others.
    """

    overlap: float
    error_mm: float
    motion_mm: float
    pixels: float
    drawn: float
    printed: bool
    labelled: bool
    visible: float
    honest: bool
    finite: bool
    answered: bool
    in_step: bool
    leaked: float
    bond: float
    covered: float = np.nan
    removed: float = np.nan
    doubt: str = ""

    def find_violations(self, bounds: Bounds) -> list[str]:
        """Return a sentence for each metric that exceeds its limit."""
        rules = {
            f"overlap {self.overlap:.4f} is below {bounds.overlap}": self.overlap >= bounds.overlap,
            f"error {self.error_mm:.4f} mm is above {1e3 * bounds.error:g} mm": self.error_mm <= 1e3 * bounds.error,
            f"projection is {self.pixels:.3g} pixels off, more than {bounds.pixels:g}": self.pixels <= bounds.pixels,
            f"the drawn outline is {self.drawn:.1f} pixels off, more than {bounds.drawn:g}": self.drawn <= bounds.drawn,
            "an image does not show its frame number or the distance to the tumour": self.printed,
            "the distance to the tumour is cut off, or far from the tip": self.labelled,
            f"drape and bone cover the tumour: {self.visible:.0%} of it is visible, less than {bounds.visible:.0%}; "
            "choose another --tilt": not self.visible < bounds.visible,
            "what the drape or bone covers is drawn as if it were visible, or the image does not say so": self.honest,
            "the tumour never moves: nothing was shown": self.motion_mm > 0.0,
            "a number is not finite, or the visible cortex does not move as the FEM surface": self.finite,
            f"a solution is not good: {self.doubt}": self.answered,
            "an image shows the solution at another time": self.in_step,
            f"the ellipsoid holds the tumour's middle in {self.covered:.0%} of the frames, less than "
            f"{bounds.covered:.0%}": not self.covered < bounds.covered,
            f"estimates remove {self.removed:.0%} of the tumour's motion, less than {bounds.removed:.0%}": not (
                self.removed < bounds.removed
            ),
        }
        return [sentence for sentence, kept in rules.items() if not kept]

    def to_row(self) -> dict[str, float | bool | str | None]:
        """Convert the metrics to a JSON object; values that are not finite become None, since JSON has no infinity."""
        figures = asdict(self)
        return {name: value if name == "doubt" or np.isfinite(value) else None for name, value in figures.items()}


def measure_frames(
    player: Player, get_camera: Callable[[float], Camera], frames: Sequence[Frame], reference: Deformation
) -> SceneFigures:
    """Compare drawn frames with the FEM solutions of the same loads, and return the worst metrics over all frames.

    `reference` contains one load case per frame. `get_camera` returns the scene's camera at a time [s].
    """
    doubts = _list_unreliable(frames, reference)
    moved = [
        np.linalg.norm(
            reference.restrict(player.stage.select_stage(frame.loads).anatomy.tumour_nodes).displacement[row], axis=1
        ).mean()
        for row, frame in enumerate(frames)
    ]
    finite = [_is_finite(frame) and _is_cortex_embedded(player, frame) for frame in frames]
    misses = [
        _compare_frame(player, get_camera(frame.time), frame, reference, row) if finite[row] else WORST_MISS
        for row, frame in enumerate(frames)
    ]
    overlap, error, pixels, drawn, visible, honestly = zip(*misses, strict=True)
    return SceneFigures(
        overlap=min(overlap),
        error_mm=1e3 * max(error),
        motion_mm=1e3 * float(max(moved)),
        pixels=max(pixels),
        drawn=max(drawn),
        printed=all(good and has_printed_numbers(player, frame) for good, frame in zip(finite, frames, strict=True)),
        labelled=all(good and has_distance_at_tip(player, frame) for good, frame in zip(finite, frames, strict=True)),
        visible=min(visible),
        honest=all(honestly),
        finite=all(finite),
        answered=not doubts,
        in_step=all(
            bool(frame.deformation.time[0] == frame.time == time)
            for frame, time in zip(frames, reference.time, strict=True)
        ),
        leaked=float(reference.leaked.max()),
        bond=float(reference.bond.max()),
        covered=_compute_coverage(player, frames, reference),
        removed=_compute_removed_share(player, frames, reference) if all(finite) else np.nan,
        doubt="" if not doubts else doubts[0] + (f" ({len(doubts) - 1} more)" if doubts[1:] else ""),
    )


def _compute_coverage(player: Player, frames: Sequence[Frame], true_solutions: Deformation) -> float:
    """Compute the share of frames whose ellipsoid contains the FEM tumour's centroid; NaN without estimates."""
    if not any(frame.estimate for frame in frames):
        return np.nan
    anatomy, held = player.site.anatomy, []
    for row, frame in enumerate(frames):
        ellipsoid = None if frame.estimate is None else frame.estimate.build_ellipsoid()
        middle = compute_centroid_motion(anatomy, player.compute_positions(true_solutions, row)[None])[0]
        held.append(ellipsoid is not None and is_within_surface(ellipsoid, middle))
    return float(np.mean(held))


def is_within_surface(surface: Layer, point: np.ndarray) -> bool:
    """Return True if a closed convex surface, with triangles oriented outwards, contains a point (3,) [m]."""
    a, b, c = np.moveaxis(surface.vertices[surface.triangles], 1, 0)
    return bool((np.einsum("fi,fi->f", np.cross(b - a, c - a), point - a) <= 0.0).all())


def _compute_removed_share(player: Player, frames: Sequence[Frame], true_solutions: Deformation) -> float:
    """Compute 1 - (sum of errors) / (sum of motions) over tumour vertices and frames; NaN without estimates."""
    if not any(frame.estimate for frame in frames):
        return np.nan
    nodes, rest = player.site.anatomy.tumour_nodes, player.site.anatomy.mesh.nodes
    true = np.stack([player.compute_positions(true_solutions, row)[nodes] for row in range(len(frames))])
    believed = np.stack([player.estimate_positions(frame)[nodes] for frame in frames])
    left, moved = (np.linalg.norm(apart, axis=2).sum() for apart in (believed - true, true - rest[nodes]))
    return float(1.0 - left / moved) if moved > 0.0 else np.nan


def _list_unreliable(frames: Sequence[Frame], true_solutions: Deformation) -> list[str]:
    """List a sentence for each drawn or FEM solution with a bad outcome: frame, source and outcome."""
    found = []
    for frame, true in zip(frames, true_solutions.outcome, strict=True):
        outcomes = {"as drawn": frame.deformation.outcome[0], "by the finite elements": true}
        found += [f"frame {frame.number} {whose}, {one.value}" for whose, one in outcomes.items() if not one.good]
    return found


def list_warnings(frames: Sequence[Frame]) -> list[str]:
    """List warnings about the estimates of the tumour position in the frames of a scene with an observation model.

    Warnings count the frames that the locator rejects or doubts, and name the first reason. Another warning appears if
    the tumour hardly moves in most frames: the removed share then shows mainly the rigid error. Warnings set no limits.
    """
    estimates = [frame.estimate for frame in frames if frame.estimate is not None]
    refused = [estimate.rejection for estimate in estimates if estimate.location is None]
    slipped = [estimate.location.doubt for estimate in estimates if estimate.location and estimate.location.slipped]
    found = [
        f"the locator {does} in {len(reasons)} of {len(estimates)} frames: {reasons[0]}"
        for does, reasons in {"rejects the observation": refused, "doubts its result": slipped}.items()
        if reasons
    ]
    motion = np.linalg.norm([estimate.true_motion for estimate in estimates], axis=1) if estimates else np.zeros(0)
    moving = np.count_nonzero(motion > STILL_SHARE * motion.max(initial=0.0))
    if moving < 0.5 * len(motion):
        found.append(
            f"the tumour moves in {moving} of {len(motion)} frames, and elsewhere the rigid error alone is estimated: "
            "give a smaller --every"
        )
    return found


def _is_finite(frame: Frame) -> bool:
    return bool(np.isfinite(frame.picture.depth).all() and np.isfinite(frame.deformation.displacement).all())


def _is_cortex_embedded(player: Player, frame: Frame) -> bool:
    """Return True if the visible cortex moves with the FEM surface in which it is embedded."""
    stage = player.stage.select_stage(frame.loads)
    if not stage.scene.look.natural:
        return True
    surface, at = stage.fine_cortex.surface, player.compute_positions(frame.deformation)[stage.fine_cortex.vertices]
    away = surface.compute_vertices(at) - surface.interpolate(at)
    normal = surface.interpolate(compute_vertex_normals(at, surface.coarse))
    aside = away - np.einsum("mi,mi->m", away, normal)[:, None] * normal / np.square(normal).sum(axis=1, keepdims=True)
    return float(np.abs(aside).max()) < MAX_ASIDE and float(np.einsum("mi,mi->m", away, normal).max()) < MAX_ASIDE


def _compare_frame(player: Player, camera: Camera, frame: Frame, truth: Deformation, row: int) -> tuple[float, ...]:
    """Compare one frame with row `row` of the FEM solution `truth`.

    Returns overlap, mean distance [m], projection and outline distances [pixel], the share of the drawn silhouette that
    the drape does not cover, and True if parts of the tumour that are not under visible cortex are drawn as occluded.
    """
    stage = player.stage.select_stage(frame.loads)
    believed = player.estimate_positions(frame)
    shown = stage.build_tumour(believed)
    true = stage.build_tumour(player.compute_positions(truth, row))
    inside = compute_silhouette(frame.camera, shown.vertices, shown.triangles)
    covered = frame.picture.segmentation[inside > 0] == DRAPE
    visible = 1.0 - float(covered.mean()) if len(covered) else 0.0
    overlap = compute_iou(inside, compute_silhouette(camera, true.vertices, true.triangles))
    nodes = stage.anatomy.tumour_nodes
    off = (believed - player.compute_positions(truth, row))[nodes]
    ours = frame.camera.project(shown.vertices)[0]
    pixels = np.linalg.norm(ours - project_cv2(camera, shown.vertices), axis=1).max()
    mean = float(np.linalg.norm(off, axis=1).mean())
    mask = render_silhouette(camera, true if frame.estimate is None else shown)
    drawn = measure_outline_error(frame, mask)
    if frame.estimate is not None:  # both are in the image
        drawn = max(drawn, measure_true_outline_error(frame, render_silhouette(camera, true)))
    # NaN: a point is behind the camera.
    pixels = np.inf if np.isnan(pixels) else float(pixels)
    return overlap, mean, pixels, drawn, visible, has_hidden_mark(frame, mask)
