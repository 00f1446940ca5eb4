"""Head model before meshing, used for the template and for label volumes."""

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
        Diameter of the craniotomy along the cortex [m]. None: depends on the tumour, see `choose_diameter`.
    meshing
        Options for mesh generation and smoothing.
    placement
        Limits of brainstem and craniotomy.
    fine_opening
        True to halve edges at the exposed cortex, so that contact forces depend less on the mesh; adds further nodes.

    Raises
    ------
    InputError
        `nodes` is outside 2,000 to 250,000, or the craniotomy is outside 15 to 120 mm.
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
    """Part of brain or tumour with its own stiffness: region label, level set, and volume [m^3] in the label map.

    Necrosis is a part of the tumour; all other parts belong to the brain.
    """

    label: int
    level_set: Field
    volume: float


@dataclass(frozen=True, eq=False)
class Subject:
    """Brain with a tumour, in the RAS coordinates of the source image [m].

    Parameters
    ----------
    brain, tumour
        Level sets of the whole solid (brain and tumour together) and of the tumour.
    cortex, interface
        Points (n, 3) [m] on the surface of the solid, and on the surface of the tumour.
    tumour_volume
        Volume of the tumour [m^3].
    site
        Centre (3,) [m] of the craniotomy on the cortex.
    intensity
        T1 intensities, or None.
    notes
        Notes for the user on changes made while reading.
    pieces
        Connected components of the tumour, the largest component first.
    parts
        Parts that become regions; if two parts overlap, the later part has priority.
    septa
        Dural sheets at which nodes are fixed.
    outline
        Closed curve (n, 3) [m] around the craniotomy, or None for a disc.
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
    """Return the mesh of a subject with boundary conditions; the result is reproducible bit by bit.

    Raises
    ------
    InputError
        `build_mesh` or `add_boundary_conditions` rejects the input.
    """
    craniotomy = choose_diameter(subject, plan)
    opening = subject.cortex[find_exposed_cortex(subject, craniotomy)]
    low, high = subject.cortex.min(axis=0), subject.cortex.max(axis=0)
    solids = Solids(
        subject.brain, subject.tumour, low, high, subject.tumour_volume, subject.interface, opening, subject.pieces
    )
    mesh = _assign_regions(build_mesh(solids, plan.nodes, plan.meshing), subject)
    made = add_boundary_conditions(mesh, subject.site, craniotomy, plan.placement, subject.outline, subject.septa)
    return refine(made, near_opening=True) if plan.fine_opening else made


def choose_diameter(subject: Subject, plan: MeshPlan) -> float:
    """Return the diameter [m] in the plan or, if None, that of the tumour plus 10 mm on each side, in 50 to 120 mm."""
    if plan.craniotomy is not None:
        return plan.craniotomy
    centre = subject.interface.mean(axis=0)
    axis = (centre - subject.site) / max(float(np.linalg.norm(centre - subject.site)), 1e-9)
    arm = subject.interface - centre
    aside = np.linalg.norm(arm - np.outer(arm @ axis, axis), axis=1)
    return float(np.clip(2.0 * (np.percentile(aside, 95.0) + TUMOUR_MARGIN), USUAL_CRANIOTOMY, MAX_CRANIOTOMY))


def _assign_regions(mesh: TetMesh, subject: Subject) -> TetMesh:
    """Return the mesh with the regions of the subject's parts.

    Tetrahedra are assigned to a part in order of their fraction inside it, until the volumes agree best.
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
    """Return a mask (n,) of the cortex points in the craniotomy: inside its outline, or in a disc of `diameter` [m].

    Distances are Euclidean, slightly shorter than the geodesic distances used on the mesh.
    """
    if subject.outline is not None:
        return find_within_outline(subject.cortex, subject.outline)
    return np.linalg.norm(subject.cortex - subject.site, axis=1) <= 0.5 * diameter


def find_boundary_voxels(mask: np.ndarray, affine: np.ndarray) -> np.ndarray:
    """Return the centres (n, 3) [m] of the voxels on the boundary of a `mask` (I, J, K)."""
    padded = np.pad(mask, 1)
    index = np.argwhere(padded & ~cast(np.ndarray, ndimage.binary_erosion(padded))) - 1
    return index @ affine[:3, :3].T + affine[:3, 3]
