"""Accuracy of each element: the tumour's motion under one press, on meshes from coarse to fine."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from scenes.analysis.measurement import time_work
from sim.accuracy import Accuracy
from sim.anatomy import Anatomy
from sim.discretisation.footprint import find_nearest_point
from sim.effects import build_push_effects
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads, push
from sim.material import Material

# Small compared with the mesh's error, and attainable in float64 at any Poisson's ratio.
ACCURACY = Accuracy(tolerance=1e-5)


@dataclass(frozen=True)
class PressCase:
    """One press on the cortex above the tumour: law, E [Pa], force [N] and footprint radius [m]."""

    law: str = "neo-hookean"
    young: float = 3000.0
    force: float = 0.1
    footprint: float = 7e-3


@dataclass(frozen=True)
class ElementRow:
    """Mean motion of the tumour [mm] on one mesh; time of set-up and of the solve [s]; True if converged."""

    poisson: float
    element: str
    vertices: int
    nodes: int
    motion: float
    set_up: float
    solve: float
    outer: int
    good: bool


def measure_motions(
    anatomies: Sequence[Anatomy], elements: Sequence[str], poissons: Sequence[float], press: PressCase, device: str
) -> Iterator[ElementRow]:
    """Yield a row for each Poisson's ratio, element and anatomy.

    Raises
    ------
    InputError
        An anatomy without tumour or open cortex.
    """
    for anatomy in anatomies:
        _loads(anatomy, press)
    for poisson in poissons:
        for element in elements:
            for anatomy in anatomies:
                yield _measured(anatomy, element, poisson, press, device)


def extrapolate_motions(rows: Sequence[ElementRow]) -> dict[float, float]:
    """Extrapolate the tumour's motion [mm] to an infinitely fine mesh, for each Poisson's ratio.

    Richardson's extrapolation of the quadratic element on the two finest meshes. Its error is taken as second order in
    h = vertices^(-1/3): at the rim of the opening the solution is not smooth enough for more.
    """
    out = {}
    for poisson in {row.poisson for row in rows}:
        mine = sorted(
            (row for row in rows if row.poisson == poisson and row.element == "p2" and row.good),
            key=lambda row: row.vertices,
        )
        if len(mine) >= 2 and mine[-1].vertices > mine[-2].vertices:
            ratio = (mine[-1].vertices / mine[-2].vertices) ** (2.0 / 3.0)
            out[poisson] = mine[-1].motion + (mine[-1].motion - mine[-2].motion) / (ratio - 1.0)
    return out


def _loads(anatomy: Anatomy, press: PressCase) -> Loads:
    """Build a push towards the tumour's centre at the nearest point of the open cortex."""
    point, centre = find_point_above_tumour(anatomy)
    inward = (centre - point) / np.linalg.norm(centre - point)
    return push(point, press.force * inward, press.footprint)


def find_point_above_tumour(anatomy: Anatomy) -> tuple[np.ndarray, np.ndarray]:
    """Return the point (3,) [m] of the open cortex nearest to the tumour's centre, and the centre (3,) [m].

    Raises
    ------
    InputError
        An anatomy without tumour or open cortex.
    """
    if not len(anatomy.tumour_nodes) or not len(anatomy.open_surface):
        raise InputError("the anatomy has no tumour, or no open cortex above it: make one with `sulcus anatomy`.")
    nodes = anatomy.mesh.nodes
    centre = nodes[anatomy.tumour_nodes].mean(axis=0)
    return find_nearest_point(nodes[anatomy.open_surface], centre), centre


def _measured(anatomy: Anatomy, element: str, poisson: float, press: PressCase, device: str) -> ElementRow:
    mesh = anatomy.mesh
    effects = build_push_effects(anatomy, Material(press.law, press.young, poisson))
    fem, set_up = time_work(Fem, anatomy, effects, ACCURACY, device, element=element)
    loads = _loads(anatomy, press)
    fem.deform(loads.scale(1e-3))  # kernels are compiled or loaded at their first launch
    answer, seconds = time_work(fem.deform, loads)
    motion = np.linalg.norm(compute_tumour_motion(anatomy, answer.displacement)[0])
    return ElementRow(
        poisson=poisson, element=element, vertices=len(mesh.nodes), nodes=fem.space.count,
        motion=1e3 * float(motion), set_up=set_up, solve=seconds,
        outer=int(answer.iterations[0]), good=answer.outcome[0].good,
    )  # fmt: skip


def compute_tumour_motion(anatomy: Anatomy, displacement: np.ndarray) -> np.ndarray:
    """Compute the volume mean (B, 3) [m] of the tumour's motion from displacements (B, V, 3) [m]."""
    mesh = anatomy.mesh
    inside = anatomy.in_tumour
    return np.average(displacement[:, mesh.tets[inside]].mean(axis=2), axis=1, weights=mesh.volumes[inside])
