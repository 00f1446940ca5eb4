"""Tetrahedral meshes: nodes, linear or quadratic tetrahedra, region labels, and surfaces."""

import hashlib
import warnings
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..errors import InputError

FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])  # Corners of the faces, with outward normals.
EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])  # Corners of the edges.
# Edges of quadratic tetrahedra in the order of VTK and meshio; corners, then mid-edge nodes, with corners 2, 3 swapped.
QUADRATIC_EDGES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])
FLIPPED_ORDER = [0, 1, 3, 2, 4, 8, 7, 6, 5, 9]
TRIANGLE_EDGES = np.array([[0, 1], [1, 2], [2, 0]])  # Corners of a triangle's edges.
ZERO_VOLUME = 1e-12  # Volume, relative to the longest edge cubed, below which an element is degenerate.
SLIVER_DEGREES = 1.0  # Dihedral angle below which an element is a sliver [degrees].


class MeshWarning(UserWarning):
    """Warning that a mesh reduces the accuracy or is probably not as intended."""


def compute_signed_volumes(nodes: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Return the signed volumes (T,) [m^3] of tetrahedra `tets` (T, 4) with `nodes` (V, 3) [m]."""
    a, b, c, d = (nodes[tets[:, k]] for k in range(4))
    return np.einsum("ti,ti->t", np.cross(b - a, c - a), d - a) / 6.0


def find_boundary_faces(tets: np.ndarray) -> np.ndarray:
    """Return the outward triangles (S, 3) that belong to exactly one of the tetrahedra `tets` (T, 4)."""
    faces = tets[:, FACES].reshape(-1, 3)
    _, first, count = np.unique(compute_row_keys(faces), return_index=True, return_counts=True)
    return faces[np.sort(first[count == 1])]


def compute_row_keys(rows: np.ndarray) -> np.ndarray:
    """Return one key (n,) for each row (n, 2) or (n, 3) of node numbers, independent of the order within a row.

    Sorting keys is ten times faster than sorting rows. Keys are unique for up to two million nodes.
    """
    key, base = np.int64(0), np.int64(rows.max()) + 1
    for column in np.sort(rows, axis=1).T:
        key = key * base + column
    return np.asarray(key)


def compute_dihedral_angles(nodes: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Compute the dihedral angles (T, 6) [degrees] at the edges of each tetrahedron."""
    corners = nodes[tets[:, FACES]]  # (T, 4, 3, 3)
    normals = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    pairs = np.einsum("tei,tei->te", normals[:, EDGES[:, 0]], normals[:, EDGES[:, 1]])
    return 180.0 - np.degrees(np.arccos(np.clip(pairs, -1.0, 1.0)))


@dataclass(frozen=True, eq=False)
class TetMesh:
    """Tetrahedral mesh in metres, linear unless it has mid-edge nodes.

    Parameters
    ----------
    nodes
        Node coordinates (V, 3) float64 [m].
    tets
        Node numbers (T, 4) of positively oriented tetrahedra.
    region
        Integer region labels (T,); each label may have its own tissue law.
    middles
        Numbers (T, 6) of the mid-edge nodes on `QUADRATIC_EDGES` of quadratic tetrahedra, or None.

    Raises
    ------
    InputError
        A shape is wrong, a coordinate is not finite, a node number is out of range, or the volume of an element is zero
        or negative (`orient_tetrahedra` corrects negative volumes).

    Warns
    -----
    MeshWarning
        A dihedral angle is below one degree, or the mesh is smaller than 1 mm or larger than 10 m.

    Examples
    --------
    >>> from sim import TetMesh
    >>> nodes = 0.01 * np.eye(4, 3, k=-1)  # origin, and 10 mm along each axis
    >>> mesh = TetMesh(nodes, tets=np.array([[0, 1, 2, 3]]), region=np.array([1]))
    >>> print(f"{1e9 * mesh.volumes.sum():.1f} mm^3")
    166.7 mm^3
    """

    nodes: np.ndarray
    tets: np.ndarray
    region: np.ndarray
    middles: np.ndarray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "nodes", np.array(self.nodes, np.float64, order="C"))
        object.__setattr__(self, "tets", np.array(self.tets, np.int32, order="C"))
        object.__setattr__(self, "region", np.array(self.region, np.int32, order="C"))
        _check_corners(self.nodes, self.tets)
        if self.region.shape != (len(self.tets),):
            raise InputError(f"region has shape {self.region.shape}: give one label for each of {len(self.tets)} tets.")
        if self.middles is not None:
            object.__setattr__(self, "middles", np.array(self.middles, np.int32, order="C"))
            _check_mid_edge_nodes(self)
        longest = np.linalg.norm(
            self.nodes[self.tets[:, EDGES[:, 0]]] - self.nodes[self.tets[:, EDGES[:, 1]]], axis=2
        ).max(axis=1)
        bad = np.flatnonzero(self.volumes <= ZERO_VOLUME * longest**3)
        if len(bad):
            raise InputError(
                f"tetrahedron {bad[0]} (and {len(bad) - 1} more) has volume {self.volumes[bad[0]]:.3g} m^3: "
                "zero or negative. Remove degenerate elements, or turn negative ones with `orient_tetrahedra`."
            )
        _warn_of_poor_elements(self)
        for array in self.arrays:
            array.flags.writeable = False

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """Arrays that define the mesh: nodes, tetrahedra, regions and, if present, mid-edge nodes."""
        linear = self.nodes, self.tets, self.region
        return linear if self.middles is None else (*linear, self.middles)

    @cached_property
    def table(self) -> np.ndarray:
        """Node numbers of each tetrahedron: (T, 4) or, if quadratic, (T, 10) with corners, then mid-edge nodes."""
        return self.tets if self.middles is None else np.hstack([self.tets, self.middles])

    @cached_property
    def volumes(self) -> np.ndarray:
        """Element volumes (T,) [m^3], computed with straight edges."""
        return compute_signed_volumes(self.nodes, self.tets)

    @cached_property
    def surface(self) -> np.ndarray:
        """Outer triangles (S, 3), as corner node numbers, with outward normals."""
        return find_boundary_faces(self.tets)

    def mark_elements(self, *labels: int) -> np.ndarray:
        """Return the mask (T,) of the elements in the regions `labels`."""
        return np.isin(self.region, labels)

    def find_boundary(self, *labels: int) -> np.ndarray:
        """Return the boundary triangles (S, 3) of the union of regions, by corner node numbers, normals outwards."""
        return find_boundary_faces(self.tets[self.mark_elements(*labels)])

    def find_nodes(self, *labels: int) -> np.ndarray:
        """Return the sorted node numbers (n,) of the elements in the regions `labels`."""
        return np.unique(self.table[self.mark_elements(*labels)])

    @cached_property
    def digest(self) -> str:
        """Hexadecimal hash of `arrays`, equal for equal meshes."""
        return compute_digest(*self.arrays)

    within, nodes_of = mark_elements, find_nodes  # Former names, for one release.


def compute_digest(*arrays: np.ndarray) -> str:
    """Return the SHA-256 hash of bytes and shapes of the arrays, shortened to 16 hexadecimal digits."""
    sha = hashlib.sha256()
    for array in arrays:
        little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        sha.update(str(little.shape).encode() + little.dtype.str.encode() + little.tobytes())
    return sha.hexdigest()[:16]


def orient_tetrahedra(nodes: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, int]:
    """Return positively oriented tetrahedra, and the number of reoriented ones. Zero volumes remain unchanged.

    `cells` are corners (T, 4), or corners and mid-edge nodes (T, 10), which are swapped along with the corners.

    Raises
    ------
    InputError
        A shape is wrong, a coordinate is not finite, or a node number is out of range.
    """
    tets = cells[:, :4] if cells.shape[1:] == (10,) else cells
    _check_corners(nodes, tets)
    negative, turned = compute_signed_volumes(nodes, tets) < 0.0, np.array(cells)
    turned[negative] = turned[negative][:, FLIPPED_ORDER[: cells.shape[1]]]
    return turned, int(negative.sum())


def _check_corners(nodes: np.ndarray, tets: np.ndarray) -> None:
    if nodes.ndim != 2 or nodes.shape[1] != 3:
        raise InputError(f"nodes have shape {nodes.shape}: give (V, 3) coordinates in metres.")
    if tets.ndim != 2 or tets.shape[1] != 4 or len(tets) == 0:
        raise InputError(f"tets have shape {tets.shape}: give (T, 4) node numbers, at least one element.")
    if not np.isfinite(nodes).all():
        node = int(np.flatnonzero(~np.isfinite(nodes).all(axis=1))[0])
        raise InputError(f"node {node} has the coordinates {nodes[node]}: every coordinate must be finite.")
    least, most = tets.min(), tets.max()
    if least < 0 or most >= len(nodes):
        raise InputError(f"tets name node {min(least, 0) or most}, but the mesh has nodes 0 to {len(nodes) - 1}.")


def _check_mid_edge_nodes(mesh: TetMesh) -> None:
    middles, count = mesh.middles, len(mesh.tets)
    assert middles is not None
    if middles.shape != (count, 6):
        raise InputError(f"middles have shape {middles.shape}: give six node numbers for each of {count} tets.")
    if middles.min() < 0 or middles.max() >= len(mesh.nodes):
        raise InputError(f"middles name a node outside the mesh's, 0 to {len(mesh.nodes) - 1}.")
    if np.intersect1d(middles, mesh.tets).size:
        raise InputError(f"node {np.intersect1d(middles, mesh.tets)[0]} is a corner and the middle of an edge at once.")
    ends = np.sort(mesh.tets[:, QUADRATIC_EDGES].reshape(-1, 2), axis=1)
    pairs = np.unique(np.column_stack([compute_row_keys(ends), middles.ravel()]), axis=0)
    if len(pairs) != len(np.unique(pairs[:, 0])) or len(pairs) != len(np.unique(pairs[:, 1])):
        raise InputError("tetrahedra that share an edge disagree on its middle node: the mesh does not conform.")


def _warn_of_poor_elements(mesh: TetMesh) -> None:
    size = float(np.ptp(mesh.nodes[np.unique(mesh.tets)], axis=0).max())
    if not 1e-3 <= size <= 10.0:
        unit, held = ("m", "metres") if size < 1.0 else ("mm", "millimetres")
        warnings.warn(
            f"the body measures {size:.3g} m: coordinates must be metres. Read it with unit {unit} if it has {held}.",
            MeshWarning,
            stacklevel=4,
        )
    slivers = int((compute_dihedral_angles(mesh.nodes, mesh.tets).min(axis=1) < SLIVER_DEGREES).sum())
    if slivers:
        warnings.warn(
            f"{slivers} tetrahedra have a dihedral angle below {SLIVER_DEGREES:g} degree: "
            "expect slow convergence; remesh if you can.",
            MeshWarning,
            stacklevel=4,
        )
