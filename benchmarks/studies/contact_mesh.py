"""Error of a contact force due to the mesh: a ball moves over one cell, and over the same cell refined."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from scenes.analysis.measurement import time_work
from sim.accuracy import TRAIN
from sim.anatomy import Anatomy
from sim.bodies.refine import refine
from sim.effects import ToolContact, ToolForce, build_push_effects
from sim.fem import Fem
from sim.loads import Loads, Touching
from sim.material import Tissue
from sim.tools import Ball
from surrogate.data.tool_loads import build_rotations_about

from .elements import find_point_above_tumour

# Positions of the ball along one long edge of the surface, as shares of the edge's length.
PLACES = np.linspace(0.0, 1.0, 5)


@dataclass(frozen=True)
class ContactMeshRow:
    """Forces on a ball [N] at its positions; NaN where the solution is not good.

    Parameters
    ----------
    element, depth
        Finite element, and depth of the ball in the undeformed surface [m].
    along
        (places,) force component along the surface's normal.
    sideways
        (places,) norm of the tangential component.
    fine
        (places,) normal component on the mesh with halved cells at the opening.
    seconds, fine_seconds
        Duration of all positions together on each mesh.
    """

    element: str
    depth: float
    along: np.ndarray
    sideways: np.ndarray
    fine: np.ndarray
    seconds: float
    fine_seconds: float

    @property
    def relative_excess(self) -> float:
        """Mean excess of the force over that on the finer mesh, as a share of the finer mesh's force."""
        return float(np.mean(self.along / self.fine - 1.0))

    @property
    def relative_range(self) -> float:
        """Range of the force over the positions, as a share of the mean force."""
        return float(np.ptp(self.along) / self.along.mean())


def measure_forces(
    anatomy: Anatomy, elements: Sequence[str], depths: Sequence[float], radius: float, tissue: Tissue, device: str
) -> Iterator[ContactMeshRow]:
    """Yield a row for each element and depth [m] of a ball of a radius [m].

    Raises
    ------
    InputError
        An anatomy without tumour or open cortex.
    """
    normal, places = _line(anatomy)
    T = np.zeros((len(places), 1, 4, 4))
    T[..., :3, :3], T[..., 3, 3] = build_rotations_about(normal[None]), 1.0
    fine = refine(anatomy, near_opening=True)
    for element in elements:
        solvers = [_solver(body, element, radius, tissue, device) for body in (anatomy, fine)]
        for depth in depths:
            T[:, 0, :3, 3] = places - depth * normal
            forces, seconds = [], []
            for fem in solvers:
                found, took = time_work(fem.deform, Loads((Touching(T.copy()),)))
                seconds.append(took)
                good = np.array([outcome.good for outcome in found.outcome])
                forces.append(np.where(good[:, None], found.reaction[:, 0, :3], np.nan))
            along, finer = (np.abs(force @ normal) for force in forces)
            sideways = np.sqrt(np.maximum((forces[0] ** 2).sum(axis=1) - along**2, 0.0))
            yield ContactMeshRow(element, depth, along, sideways, finer, *seconds)


def _line(anatomy: Anatomy) -> tuple[np.ndarray, np.ndarray]:
    """Return the outward normal (3,) over the tumour, and positions (p, 3) [m] along the longest edge there."""
    point, _ = find_point_above_tumour(anatomy)
    corners = anatomy.mesh.nodes[anatomy.open_surface]
    a, b, c = corners[np.linalg.norm(corners.mean(axis=1) - point, axis=1).argmin()]
    normal = np.cross(b - a, c - a)
    start, end = max(((a, b), (b, c), (c, a)), key=lambda edge: float(np.linalg.norm(edge[1] - edge[0])))
    return normal / np.linalg.norm(normal), start + PLACES[:, None] * (end - start)


def _solver(anatomy: Anatomy, element: str, radius: float, tissue: Tissue, device: str) -> Fem:
    passive = (effect for effect in build_push_effects(anatomy, tissue) if not isinstance(effect, ToolForce))
    return Fem(anatomy, [*passive, ToolContact((Ball(radius),))], TRAIN, device, element=element)
