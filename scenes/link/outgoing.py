"""The messages of an answer: surfaces, the tumour's pose, distances with bounds, and places that were sent."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from ar.overlay.hud import bound_words, millimetres
from sim.geometry.closest_point import closest

from ..play.overlay.follower import Known, State
from ..play.stage import Stage
from .answer import Answer
from .frame import BadMessageError, framed
from .messages import NOTHING, Code, Mesh, points, polydata, status, string, transform

# A place that is asked for belongs to tumour or open cortex where the scan has it no farther from them [m].
BESIDE = 2e-3
MOST_PLACES = 1000
"""So many places may be asked for at once."""
NONE = np.empty((0, 3))


@dataclass(frozen=True, eq=False)
class Places:
    """Places on tumour or open cortex.

    Parameters
    ----------
    names
        One each.
    rest
        Where the scan has them (n, 3) [m].
    vertices, weights
        (n, 3): the mesh's vertices that they move with, and how much with each.
    """

    names: tuple[str, ...]
    rest: np.ndarray
    vertices: np.ndarray
    weights: np.ndarray


@dataclass(frozen=True, eq=False)
class Outgoing:
    """Makes messages of answers on a stage. All places are in the scan's RAS, in millimetres.

    `registered` says whether the registration's error is known.
    """

    stage: Stage
    registered: bool = True

    @cached_property
    def _surfaces(self) -> tuple[tuple[str, np.ndarray, Mesh], ...]:
        """Name, vertices and triangles of the tumour, and of the open cortex."""
        cortex, faces = np.unique(self.stage.anatomy.open_surface, return_inverse=True)
        tumour = Mesh.of(self.stage.tumour_at_rest.triangles)
        return ("Tumour", self.stage.tumour_vertices, tumour), ("Cortex", cortex, Mesh.of(faces.reshape(-1, 3)))

    def scan(self, stamp: int) -> bytes:
        """The tumour as the scan has it."""
        _, vertices, mesh = self._surfaces[0]
        at = self.stage.anatomy.mesh.nodes[vertices]
        return framed("POLYDATA", "TumourInScan", polydata(1e3 * at, mesh), stamp)

    def messages(self, answer: Answer, places: Places | None = None) -> tuple[bytes, ...]:
        """All messages of an answer, with its stamp: what is not known is sent without points."""
        known, stamp = answer.known, answer.stamp
        none = polydata(NONE, NOTHING)
        out = []
        for name, vertices, mesh in self._surfaces:
            here = _follows(known, vertices)
            body = polydata(1e3 * known.motion.positions[vertices], mesh) if here else none
            for word, shown in (("Now", known.relied), ("Doubtful", known.state is State.UNSURE)):
                out.append(framed("POLYDATA", f"{name}{word}", body if shown else none, stamp))
        if known.relied:
            rest, now = (each[self.stage.tumour_vertices] for each in (self._rest, known.motion.positions))
            out.append(framed("TRANSFORM", "TumourToRas", transform(rigid_fit(1e3 * rest, 1e3 * now)), stamp))
        out.append(framed("STRING", "TipToTumour", string(self._distance_words(answer)), stamp))
        out.append(framed("STRING", "TumourMotion", string(self._motion_words(known)), stamp))
        if places is not None:
            shown = known.relied and _follows(known, np.unique(places.vertices))
            names, at = (places.names, self._carried(known, places)) if shown else ((), NONE)
            out.append(framed("POINT", "PointsNow", points(list(names), 1e3 * at), stamp))
        return tuple(out)

    def status(self, answer: Answer, refused: str) -> bytes:
        """What is known, and how often messages were refused and why."""
        known = answer.known
        code = Code.OK if known.relied else Code.NOT_READY
        words = known.words or f"the tumour is known, {known.state.value}"
        return framed("STATUS", "Sulcus", status(code, f"{words}{refused}"), answer.stamp)

    def placed(self, names: list[str], at: np.ndarray) -> Places:
        """Find what places of the scan (n, 3) [m] move with.

        Raises
        ------
        BadMessageError
            No place or too many; one that is on neither surface, so that nobody knows how it moves.
        """
        if not 0 < len(at) <= MOST_PLACES:
            raise BadMessageError(f"no place, or more than are followed: 1 to {MOST_PLACES}")
        anatomy = self.stage.anatomy
        triangles = np.concatenate([anatomy.tumour_surface, anatomy.open_surface])
        found = closest(at, self._rest[triangles])
        away = float(np.linalg.norm(found.point - at, axis=1).max())
        if away > BESIDE:
            words = "a place that is not on tumour or open cortex, whose motion is not known"
            raise BadMessageError(f"{words}: {1e3 * away:.0f} mm away")
        return Places(tuple(names), at, triangles[found.triangle], found.weights)

    @property
    def _rest(self) -> np.ndarray:
        return self.stage.anatomy.mesh.nodes

    def _carried(self, known: Known, places: Places) -> np.ndarray:
        moved = (known.motion.positions - self._rest)[places.vertices]
        return places.rest + np.einsum("nk,nkd->nd", places.weights, moved)

    def _distance_words(self, answer: Answer) -> str:
        """The distance from tip to tumour with its error and what that is of; or why it is not known."""
        known, gauge = answer.known, answer.gauge
        if gauge is None:
            return f"not known: {known.words}"
        inside = "inside the tumour, its edge " if gauge.inside else ""
        return f"{inside}{millimetres(gauge.distance, gauge.error)} (95 %; {self._of})"

    def _motion_words(self, known: Known) -> str:
        """How far the tumour has moved, with its error and what that is of; or why that is not known."""
        if known.band is None:
            return f"not known: {known.words}"
        moved = millimetres(known.motion.moved, known.motion.error)
        return f"moved {moved}, placed within {bound_words(known.band, 1)} (95 %; {self._of})"

    @property
    def _of(self) -> str:
        """What an error is of, and what of it nobody states."""
        if self.registered:
            return "of tracking, registration and model; not known of tissue and segmentation"
        return "of tracking and model; not known of registration, tissue and segmentation"


def _follows(known: Known, vertices: np.ndarray) -> bool:
    """Whether it is known how these vertices move."""
    answer = known.motion.answer
    return answer is not None and bool(np.isin(vertices, answer.nodes).all())


def rigid_fit(rest: np.ndarray, now: np.ndarray) -> np.ndarray:
    """The rigid motion (4, 4) that takes points (n, 3) nearest to where they are now (n, 3), in their unit."""
    middle, there = rest.mean(axis=0), now.mean(axis=0)
    T = np.eye(4)
    T[:3, :3] = Rotation.align_vectors(now - there, rest - middle)[0].as_matrix()
    T[:3, 3] = there - T[:3, :3] @ middle
    return T
