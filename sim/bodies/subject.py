"""Head model before meshing, common to the template and to label volumes."""

from dataclasses import dataclass, field
from itertools import product
from typing import cast

import numpy as np
from scipy import ndimage

from ..anatomy import BRAIN_LABEL, NECROSIS_LABEL, TUMOUR_LABEL, Anatomy
from ..errors import InputError
from ..geometry.tetmesh import TetMesh
from .boundary_conditions import add_boundary_conditions
from .dural_septa import Septum
from .intensity import Intensity
from .mesher import Meshing, Solids, build_mesh
from .placement import Placement, TumourPiece, find_within_outline
from .refine import refine
from .signed_distance import Field

MIN_NODES = 2_000  # minimum mesh nodes
MAX_NODES = 250_000  # maximum mesh nodes
# Barycentric coordinates (20, 4) of sample points in a tetrahedron.
SAMPLE_WEIGHTS = np.array([corners for corners in product(range(4), repeat=4) if sum(corners) == 3]) / 4.0 + 1.0 / 16.0
MIN_CRANIOTOMY = 0.015  # minimum diameter [m]
MAX_CRANIOTOMY = 0.120  # maximum diameter [m]
USUAL_CRANIOTOMY = 0.050  # smallest diameter that is chosen [m]
TUMOUR_MARGIN = 10e-3  # distance of the chosen edge from the tumour, as seen from outside [m]


@dataclass(frozen=True)
class MeshPlan:
    """Parameters of the mesh of a subject.

    Parameters
    ----------
    nodes
        Requested number of nodes.
    craniotomy
        Diameter of the craniotomy along the cortex [m]. None: by the tumour, see `choose_diameter`.
    meshing
        Mesh generation and smoothing.
    placement
        Limits of brainstem and craniotomy.
    fine_opening
        True to halve edges at the exposed cortex, in addition to `nodes`: contact forces depend less on the mesh.

    Raises
    ------
    InputError
        Nodes outside 2,000 to 250,000, or a craniotomy outside 15 to 120 mm.
    """

    nodes: int = 5300
    craniotomy: float | None = None
    meshing: Meshing = field(default_factory=Meshing)
    placement: Placement = field(default_factory=Placement)
    fine_opening: bool = False

    def __post_init__(self) -> None:
        if not MIN_NODES <= self.nodes <= MAX_NODES:
            raise InputError(f"{self.nodes} nodes are outside {MIN_NODES} to {MAX_NODES}: choose a number between.")
        if self.craniotomy is not None and not MIN_CRANIOTOMY <= self.craniotomy <= MAX_CRANIOTOMY:
            raise InputError(
                f"a craniotomy of {self.craniotomy * 1e3:g} mm is outside {MIN_CRANIOTOMY * 1e3:g} to "
                f"{MAX_CRANIOTOMY * 1e3:g} mm: choose a diameter between."
            )


@dataclass(frozen=True, eq=False)
class SubjectPart:
    """Part of brain or tumour with its own stiffness: region label, level set, and volume [m^3] in the labels.

    Necrosis is a part of the tumour, all others of the brain.
    """

    label: int
    level_set: Field
    volume: float


@dataclass(frozen=True, eq=False)
class Subject:
    """Brain with a tumour, in RAS coordinates of the volume [m].

    Parameters
    ----------
    brain, tumour
        Level sets of the whole solid (brain and tumour together) and of the tumour.
    cortex, interface
        Points (n, 3) [m] on the solid's surface and on the tumour's.
    tumour_volume
        Volume of the tumour [m^3].
    site
        Centre (3,) [m] of the craniotomy on the cortex.
    intensity
        T1 intensities, if available.
    notes
        Notes on changes made while reading.
    pieces
        Connected components of the tumour, largest first.
    parts
        Parts that become regions; if two overlap, the later one has priority.
    septa
        Fixed sheets of dura.
    outline
        Closed curve (n, 3) [m] around the opening, instead of a disc.
    """

    brain: Field
    tumour: Field
    cortex: np.ndarray
    interface: np.ndarray
    tumour_volume: float
    site: np.ndarray
    intensity: Intensity | None = None
    notes: tuple[str, ...] = ()
    pieces: tuple[TumourPiece, ...] = ()
    parts: tuple[SubjectPart, ...] = ()
    septa: tuple[Septum, ...] = ()
    outline: np.ndarray | None = None


def make_anatomy(subject: Subject, plan: MeshPlan) -> Anatomy:
    """Mesh a subject and add its boundary conditions; the result is deterministic, bit by bit.

    Raises
    ------
    InputError
        Input that `build_mesh` or `add_boundary_conditions` rejects.
    """
    craniotomy = choose_diameter(subject, plan)
    opening = subject.cortex[find_exposed_cortex(subject, craniotomy)]
    low, high = subject.cortex.min(axis=0), subject.cortex.max(axis=0)
    solids = Solids(
        subject.brain, subject.tumour, low, high, subject.tumour_volume, subject.interface, opening, subject.pieces
    )
    mesh = _assign_parts(build_mesh(solids, plan.nodes, plan.meshing), subject)
    made = add_boundary_conditions(mesh, subject.site, craniotomy, plan.placement, subject.outline, subject.septa)
    return refine(made, near_opening=True) if plan.fine_opening else made


def choose_diameter(subject: Subject, plan: MeshPlan) -> float:
    """Return the plan's diameter of the craniotomy [m], or 10 mm more than the tumour on all sides; 50 to 120 mm."""
    if plan.craniotomy is not None:
        return plan.craniotomy
    centre = subject.interface.mean(axis=0)
    axis = (centre - subject.site) / max(float(np.linalg.norm(centre - subject.site)), 1e-9)
    arm = subject.interface - centre
    aside = np.linalg.norm(arm - np.outer(arm @ axis, axis), axis=1)
    return float(np.clip(2.0 * (np.percentile(aside, 95.0) + TUMOUR_MARGIN), USUAL_CRANIOTOMY, MAX_CRANIOTOMY))


def _assign_parts(mesh: TetMesh, subject: Subject) -> TetMesh:
    """Return the mesh with the regions of the subject's parts.

    Each part takes the tetrahedra with the largest fraction inside, until their volume is closest to its own.
    """
    region = mesh.region.copy()
    for part in reversed(subject.parts):
        around = TUMOUR_LABEL if part.label == NECROSIS_LABEL else BRAIN_LABEL
        free = np.flatnonzero(region == around)
        points = np.einsum("pk,tki->tpi", SAMPLE_WEIGHTS, mesh.nodes[mesh.tets[free]])
        share = (part.level_set(points.reshape(-1, 3)) < 0.0).reshape(points.shape[:2]).mean(axis=1)
        touched = np.argsort(-share, kind="stable")[: np.count_nonzero(share)]
        taken = np.concatenate([[0.0], np.cumsum(mesh.volumes[free[touched]])])
        region[free[touched[: np.abs(taken - part.volume).argmin()]]] = part.label
    return TetMesh(mesh.nodes, mesh.tets, region) if subject.parts else mesh


def find_exposed_cortex(subject: Subject, diameter: float) -> np.ndarray:
    """Return a mask (n,) of the subject's cortex points under its outlined opening, or under one of this diameter [m].

    Distances are Euclidean; those on the mesh are geodesic and slightly longer.
    """
    if subject.outline is not None:
        return find_within_outline(subject.cortex, subject.outline)
    return np.linalg.norm(subject.cortex - subject.site, axis=1) <= 0.5 * diameter


def find_boundary_voxels(mask: np.ndarray, affine: np.ndarray) -> np.ndarray:
    """Return the centres (n, 3) [m] of boundary voxels of `mask` (I, J, K)."""
    padded = np.pad(mask, 1)
    index = np.argwhere(padded & ~cast(np.ndarray, ndimage.binary_erosion(padded))) - 1
    return index @ affine[:3, :3].T + affine[:3, 3]
