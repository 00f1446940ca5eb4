"""Anatomy: a mesh with regions and boundary conditions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter

import numpy as np

from .errors import InputError
from .geometry.tetmesh import TetMesh, compute_digest

BRAIN_LABEL, TUMOUR_LABEL, NECROSIS_LABEL = 1, 2, 5
"""Region labels of anatomies made by this package."""
TUMOUR_LABELS = (TUMOUR_LABEL, NECROSIS_LABEL)
"""Region labels of the whole tumour: its core and its necrosis."""
PART_LABELS = {"oedema": 3, "ventricles": 4, "necrosis": NECROSIS_LABEL}
"""Region labels of the optional parts of brain and tumour that have their own stiffness, by part name."""

REGION_NAMES = {"brain": BRAIN_LABEL, "tumour": TUMOUR_LABEL, **PART_LABELS}
"""Region labels by name."""


def name_region(label: int) -> str:
    """Return the name of the region `label`, or a text such as "region 7" for a region without a name."""
    return next((name for name, number in REGION_NAMES.items() if number == label), f"region {label}")


def describe_region(label: int) -> str:
    """Return a text with the label of a region and, if there is one, its name."""
    return f"region {label} ({name_region(label)})" if label in REGION_NAMES.values() else name_region(label)


def describe_missing_region(mesh: TetMesh, label: int) -> str:
    """Return an error message, with the labels of the mesh, if it has no region `label`; else an empty string."""
    if mesh.mark_elements(label).any():
        return ""
    has = ", ".join(map(describe_region, np.unique(mesh.region).tolist()))
    return f"the mesh has no {describe_region(label)}. It has {has}."


@dataclass(frozen=True, eq=False)
class Anatomy:
    """Mesh with its boundary conditions, in the RAS coordinates of the source image [m].

    Parameters
    ----------
    mesh
        Tetrahedral mesh. Its regions are `BRAIN_LABEL` and, if present, `TUMOUR_LABELS` and those in `PART_LABELS`.
    fixed
        Mask (V, 3) of displacement components that are prescribed (zero unless a load sets them).
    slide_normal
        Unit outward normals (V, 3) of nodes under the skull, zero elsewhere. The effects `Bonded`, `Slide` and
        `SkullContact` define the contact between these nodes and the skull.
    craniotomy
        Mask (V,) of free surface nodes that a tool may touch.

    Raises
    ------
    InputError
        The shapes do not match the mesh, or a slide normal is neither zero nor of unit length.
    """

    mesh: TetMesh
    fixed: np.ndarray
    slide_normal: np.ndarray
    craniotomy: np.ndarray

    def __post_init__(self) -> None:
        count = len(self.mesh.nodes)
        object.__setattr__(self, "fixed", np.ascontiguousarray(self.fixed, bool))
        object.__setattr__(self, "slide_normal", np.ascontiguousarray(self.slide_normal, np.float64))
        object.__setattr__(self, "craniotomy", np.ascontiguousarray(self.craniotomy, bool))
        for name, shape in (("fixed", (count, 3)), ("slide_normal", (count, 3)), ("craniotomy", (count,))):
            if getattr(self, name).shape != shape:
                raise InputError(f"{name} has shape {getattr(self, name).shape}: this mesh needs {shape}.")
        length = np.linalg.norm(self.slide_normal, axis=1)
        if not np.all((length == 0.0) | (np.abs(length - 1.0) < 1e-6)):
            raise InputError("slide_normal has rows that are neither zero nor of unit length: normalise them.")

    @cached_property
    def orphaned(self) -> np.ndarray:
        """Mask (V,) of vertices that belong to no tetrahedron."""
        orphaned = np.ones(len(self.mesh.nodes), bool)
        orphaned[self.mesh.table] = False
        return orphaned

    def remove_elements(self, elements: np.ndarray) -> Anatomy:
        """Return the anatomy without the tetrahedra `elements` (n,); the vertex numbers do not change.

        New surfaces are free. Vertices without any remaining tetrahedron are fixed; tools cannot touch them.

        Raises
        ------
        InputError
            `elements` contains a number that the mesh does not have, or all tetrahedra.
        """
        mesh, taken = self.mesh, np.unique(elements)
        count = len(mesh.tets)
        beyond = taken[(taken < 0) | (taken >= count)]
        if len(beyond):
            raise InputError(f"the mesh has no tetrahedron {beyond[0]}: choose from 0 to {count - 1}.")
        if len(taken) == count:
            raise InputError(f"all {count} tetrahedra are removed: some must remain.")
        left = np.ones(count, bool)
        left[taken] = False
        middles = None if mesh.middles is None else mesh.middles[left]
        rest = Anatomy(
            TetMesh(mesh.nodes, mesh.tets[left], mesh.region[left], middles),
            self.fixed, self.slide_normal, self.craniotomy,
        )  # fmt: skip
        orphaned = rest.orphaned
        return Anatomy(
            rest.mesh,
            self.fixed | orphaned[:, None],
            np.where(orphaned[:, None], 0.0, self.slide_normal),
            self.craniotomy & ~orphaned,
        )

    @cached_property
    def in_tumour(self) -> np.ndarray:
        """Mask (T,) of tetrahedra of the tumour, including necrosis."""
        return self.mesh.mark_elements(*TUMOUR_LABELS)

    @cached_property
    def tumour_nodes(self) -> np.ndarray:
        """Sorted vertex numbers (n,) of the tumour."""
        return self.mesh.find_nodes(*TUMOUR_LABELS)

    @cached_property
    def tumour_surface(self) -> np.ndarray:
        """Outward triangles (S, 3) of the tumour's outer surface, without the interface between core and necrosis."""
        return self.mesh.find_boundary(*TUMOUR_LABELS)

    @cached_property
    def open_surface(self) -> np.ndarray:
        """Outward surface triangles (S, 3) whose corners all lie in the craniotomy."""
        surface = self.mesh.surface
        return surface[self.craniotomy[surface].all(axis=1)]

    @cached_property
    def bare(self) -> np.ndarray:
        """Mask (S,) of surface triangles that tools may touch: at least one corner is neither fixed nor sliding."""
        covered = np.logical_or(self.fixed.any(axis=1), self.slide_normal.any(axis=1))
        return np.logical_not(covered[self.mesh.surface].all(axis=1))

    @cached_property
    def digest(self) -> str:
        """Hash of the mesh and its boundary conditions."""
        return compute_digest(*self.mesh.arrays, self.fixed, self.slide_normal, self.craniotomy)

    without, held = remove_elements, property(attrgetter("fixed"))  # Former names, for one release.
