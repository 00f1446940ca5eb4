"""Messages with a result: surfaces, pose of the tumour, distances with error bounds, and requested points."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from ar.overlay.hud import format_bound, format_millimetres
from sim.geometry.closest_point import find_closest_points
from sim.geometry.locate import LocatedPoints, locate

from ..play.stage import Stage
from ..tracked.follower import TrackingResult, TumourState
from .frame import BadMessageError, pack_message
from .messages import (
    EMPTY_MESH,
    EncodedMesh,
    Status,
    encode_points,
    encode_polydata,
    encode_status,
    encode_string,
    encode_transform,
)
from .pose_responder import PoseResult

# Largest distance of a requested point from the tumour or open cortex in the scan to which it is assigned [m].
MAX_POINT_DISTANCE = 2e-3
MAX_NAMED_POINTS = 5  # Maximum number of points outside the tracked surfaces that are named.
MAX_PLACES = 1000
"""Maximum number of points in a request."""
UNTRACKED_POINTS = "places that are not in or on the tumour, nor on open cortex, so that their motion is not known"
"""Reason in a STATUS about points that are not tracked."""
# Largest distance of a point from its position by barycentric coordinates, to be inside the tetrahedron [m].
INSIDE_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class SentPoints:
    """Requested points in or on the tumour, or on the open cortex.

    Parameters
    ----------
    names
        Name of each point.
    rest
        Positions in the scan (n, 3) [m].
    vertices, weights
        Mesh vertices (n, 4) that determine the motion of each point, and their interpolation weights (n, 4).
    unattached
        Description of the points that cannot be tracked, with their distances; empty if all points are tracked.
    """

    names: tuple[str, ...]
    rest: np.ndarray
    vertices: np.ndarray
    weights: np.ndarray
    unattached: str = ""


@dataclass(frozen=True, eq=False)
class ResultEncoder:
    """Encoder of results as messages. All encoded positions are in scan coordinates (RAS), in millimetres.

    `registered` is True if the error of the registration is known.
    """

    stage: Stage
    registered: bool = True

    @cached_property
    def _surfaces(self) -> tuple[tuple[str, np.ndarray, EncodedMesh], ...]:
        """Name, vertices and encoded triangles of the surfaces of the tumour and of the open cortex."""
        cortex, faces = np.unique(self.stage.anatomy.open_surface, return_inverse=True)
        tumour = EncodedMesh.from_triangles(self.stage.tumour_at_rest.triangles)
        return ("Tumour", self.stage.tumour_vertices, tumour), (
            "Cortex",
            cortex,
            EncodedMesh.from_triangles(faces.reshape(-1, 3)),
        )

    def build_scan(self, stamp: int) -> bytes:
        """Return the message with the tumour's surface in the scan."""
        _, vertices, mesh = self._surfaces[0]
        at = self.stage.anatomy.mesh.nodes[vertices]
        return pack_message("POLYDATA", "TumourInScan", encode_polydata(1e3 * at, mesh), stamp)

    def build_messages(self, result: PoseResult, points: SentPoints | None = None) -> tuple[bytes, ...]:
        """Build all messages of a result, with its time stamp; a surface that is not known is sent without vertices."""
        known, stamp = result.tracking, result.stamp
        none = encode_polydata(np.empty((0, 3)), EMPTY_MESH)
        out = []
        for name, vertices, mesh in self._surfaces:
            here = _is_motion_known(known, vertices)
            body = encode_polydata(1e3 * known.motion.positions[vertices], mesh) if here else none
            for word, shown in (("Now", known.is_reliable), ("Doubtful", known.state is TumourState.UNSURE)):
                out.append(pack_message("POLYDATA", f"{name}{word}", body if shown else none, stamp))
        if known.is_reliable:
            rest, now = (each[self.stage.tumour_vertices] for each in (self._rest, known.motion.positions))
            motion = encode_transform(fit_rigid(1e3 * rest, 1e3 * now))
            out.append(pack_message("TRANSFORM", "TumourToRas", motion, stamp))
        out.append(pack_message("STRING", "TipToTumour", encode_string(self._format_distance(result)), stamp))
        out.append(pack_message("STRING", "TumourMotion", encode_string(self._format_motion(known)), stamp))
        if points is not None:
            body = self._build_point_message(known, points)
            for word, shown in (("Now", known.is_reliable), ("Doubtful", known.state is TumourState.UNSURE)):
                out.append(pack_message("POINT", f"Points{word}", body if shown else b"", stamp))
        return tuple(out)

    def build_status(self, result: PoseResult, rejected: str) -> bytes:
        """Build the STATUS message of a result; `rejected` describes rejected messages."""
        known = result.tracking
        code = Status.OK if known.is_reliable else Status.NOT_READY
        words = known.warning or f"the tumour is known, {known.state.value}"
        return pack_message("STATUS", "Sulcus", encode_status(code, f"{words}{rejected}"), result.stamp)

    def attach_points(self, names: list[str], positions: np.ndarray) -> SentPoints:
        """Attach points (n, 3) [m] in the scan to tetrahedra of the tumour, or outside it to the nearest surface.

        Raises
        ------
        BadMessageError
            There are no points or too many, or no point is in or on the tumour or on the open cortex.
        """
        if not 0 < len(positions) <= MAX_PLACES:
            raise BadMessageError(f"no place, or more than are followed: 1 to {MAX_PLACES}")
        anatomy = self.stage.anatomy
        triangles = np.concatenate([anatomy.tumour_surface, anatomy.open_surface])
        found = find_closest_points(positions, self._rest[triangles])
        away = np.linalg.norm(found.point - positions, axis=1)
        corners = triangles[found.triangle]
        vertices = np.concatenate([corners, corners[:, :1]], axis=1)
        weights = np.concatenate([found.weights, np.zeros((len(positions), 1))], axis=1)
        held = locate(anatomy.mesh, positions)
        inside = self._is_in_tumour(held, positions)
        vertices[inside], weights[inside], away[inside] = held.vertices[inside], held.weights[inside], 0.0
        labels = [name or f"number {row}" for row, name in enumerate(names, 1)]
        strange = _format_names(
            [f"{labels[row]} {1e3 * away[row]:.0f} mm away" for row in np.flatnonzero(away > MAX_POINT_DISTANCE)]
        )
        good = np.flatnonzero(away <= MAX_POINT_DISTANCE)
        if not len(good):
            raise BadMessageError(f"{UNTRACKED_POINTS}: {strange}")
        return SentPoints(tuple(names[row] for row in good), positions[good], vertices[good], weights[good], strange)

    def _is_in_tumour(self, located: LocatedPoints, points: np.ndarray) -> np.ndarray:
        """Return a mask (n,) that is True for points (n, 3) [m] in tetrahedra of the tumour."""
        there = np.linalg.norm(np.einsum("nk,nkd->nd", located.weights, self._rest[located.vertices]) - points, axis=1)
        known = np.isin(located.vertices, self.stage.anatomy.tumour_nodes) | (located.weights <= 0.0)
        return known.all(axis=1) & (there <= INSIDE_TOLERANCE)

    @property
    def _rest(self) -> np.ndarray:
        return self.stage.anatomy.mesh.nodes

    def _build_point_message(self, tracking: TrackingResult, points: SentPoints) -> bytes:
        """Build the POINT message with the positions of all points whose motion is known."""
        moved = (tracking.motion.positions - self._rest)[points.vertices]
        at = 1e3 * (points.rest + np.einsum("nk,nkd->nd", points.weights, moved))
        nodes = () if tracking.motion.solution is None else tracking.motion.solution.nodes
        here = np.flatnonzero((np.isin(points.vertices, nodes) | (points.weights <= 0.0)).all(axis=1))
        return encode_points([points.names[row] for row in here], at[here])

    def _format_distance(self, result: PoseResult) -> str:
        """Describe the distance from tip to tumour with its error and its sources, or state why it is not available."""
        known, gauge = result.tracking, result.gauge
        if gauge is None:
            return f"not known: {known.warning}"
        inside = "inside the tumour, its edge " if gauge.is_inside else ""
        return f"{inside}{format_millimetres(gauge.distance, gauge.error)} (95 %; {self._source}){_format_doubt(known)}"

    def _format_motion(self, tracking: TrackingResult) -> str:
        """Describe the tumour's displacement with its error and its sources, or state why it is not available."""
        if tracking.bound is None:
            return f"not known: {tracking.warning}"
        moved = format_millimetres(tracking.motion.distance, tracking.motion.error)
        within = format_bound(tracking.bound, 1)
        return f"moved {moved}, placed within {within} (95 %; {self._source}){_format_doubt(tracking)}"

    @property
    def _source(self) -> str:
        """Description of the sources of error that a bound includes, and of the unknown sources."""
        if self.registered:
            return "of tracking, registration and model; not known of tissue and segmentation"
        return "of tracking and model; not known of registration, tissue and segmentation"


def _format_doubt(tracking: TrackingResult) -> str:
    """Describe why a result is unreliable; empty if the result is reliable."""
    return "" if tracking.is_reliable else f"; doubtful: {tracking.warning}"


def _format_names(names: list[str]) -> str:
    """Return the first names, and the number of further names, as text."""
    others = len(names) - MAX_NAMED_POINTS
    return ", ".join(names[:MAX_NAMED_POINTS]) + (f" and {others} others" if others > 0 else "")


def _is_motion_known(tracking: TrackingResult, vertices: np.ndarray) -> bool:
    """Return True if the motion of all given vertices is known."""
    result = tracking.motion.solution
    return result is not None and bool(np.isin(vertices, result.nodes).all())


def fit_rigid(rest: np.ndarray, current: np.ndarray) -> np.ndarray:
    """Fit the rigid transform (4, 4) that maps points `rest` (n, 3) to `current` positions (n, 3), in the same unit."""
    middle, there = rest.mean(axis=0), current.mean(axis=0)
    T = np.eye(4)
    T[:3, :3] = Rotation.align_vectors(current - there, rest - middle)[0].as_matrix()
    T[:3, 3] = there - T[:3, :3] @ middle
    return T
