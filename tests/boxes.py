"""Small bodies to test the solver on: structured boxes, distorted if wanted, and how they are held."""

import numpy as np
from scipy.special import erf

from sim.anatomy import Anatomy
from sim.diagnostics.skull_leak import integrate_facet_normals
from sim.geometry.tetmesh import TetMesh

# Kuhn's six tetrahedra of a cube: paths from corner 0 to corner 7 along the axes; neighbours match.
CORNER = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]])
KUHN = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])
VTK_EDGES = np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]])


def box(cells: tuple[int, int, int], size: float = 0.1, distortion: float = 0.0, seed: int = 0) -> TetMesh:
    """A box of `cells` cubes, its longest side `size` [m]; inner nodes moved by a share of a cube's side at random."""
    counts = np.array(cells) + 1
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    stride = np.array([counts[1] * counts[2], counts[2], 1])
    first = grid[(grid < counts - 1).all(axis=1)]
    tets = ((first[:, None] + CORNER) @ stride)[:, KUHN].reshape(-1, 4)
    inside = ((grid > 0) & (grid < counts - 1)).all(axis=1)
    shift = np.random.default_rng(seed).uniform(-distortion, distortion, grid.shape) * inside[:, None]
    return TetMesh((grid + shift) * size / max(cells), tets, np.zeros(len(tets), int))


def quadratic(mesh: TetMesh, curved: float = 0.0, seed: int = 0) -> TetMesh:
    """The same body of ten-node tetrahedra; inner middles moved by a share of their edge's length at random."""
    ends = np.sort(mesh.tets[:, VTK_EDGES], axis=2).reshape(-1, 2)
    edges, place = np.unique(ends, axis=0, return_inverse=True)
    outer = np.sort(mesh.surface[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
    key = [len(mesh.nodes), 1]
    length = np.linalg.norm(mesh.nodes[edges[:, 1]] - mesh.nodes[edges[:, 0]], axis=1) * ~np.isin(
        edges @ key, outer @ key
    )
    shift = np.random.default_rng(seed).uniform(-curved, curved, (len(edges), 3)) * length[:, None]
    nodes = np.vstack([mesh.nodes, mesh.nodes[edges].mean(axis=1) + shift])
    return TetMesh(nodes, mesh.tets, mesh.region, len(mesh.nodes) + place.reshape(-1, 6))


def surface_nodes(mesh: TetMesh) -> np.ndarray:
    """Nodes (V,) bool of a box that lie on its faces, mid-edge nodes too."""
    return ((mesh.nodes < 1e-9) | (mesh.nodes > mesh.nodes.max(axis=0) - 1e-9)).any(axis=1)


def hold(mesh: TetMesh, held: np.ndarray, normal: np.ndarray | None = None) -> Anatomy:
    """An anatomy that holds nodes (V,) or components (V, 3) bool, with slide normals (V, 3) if given."""
    count = len(mesh.nodes)
    slide = np.zeros((count, 3)) if normal is None else normal
    return Anatomy(mesh, np.broadcast_to(held.reshape(count, -1), (count, 3)), slide, np.zeros(count, bool))


def base_held(mesh: TetMesh) -> Anatomy:
    """The anatomy of a box whose nodes at z = 0 are held."""
    return hold(mesh, mesh.nodes[:, 2] < 1e-9)


def top_forces(mesh: TetMesh, total: np.ndarray) -> np.ndarray:
    """Nodal forces (B, V, 3) [N] that share total (B, 3) [N] among the nodes of the highest face."""
    top = mesh.nodes[:, 2] > mesh.nodes[:, 2].max() - 1e-9
    return np.atleast_2d(total)[:, None, :] * (top / top.sum())[None, :, None]


def blurred_faces(points: np.ndarray, size: tuple[float, float, float], blur: float) -> np.ndarray:
    """Outward unit normals (n, 3) at points (n, 3) [m] of a box round the origin after a Gaussian, in closed form.

    The blurred indicator is a product over the axes of differences of error functions.
    """
    low, high = ((sign * 0.5 * np.array(size) - points) / (np.sqrt(2.0) * blur) for sign in (-1.0, 1.0))
    share, slope = 0.5 * (erf(high) - erf(low)), np.exp(-(high**2)) - np.exp(-(low**2))
    outward = slope * np.roll(share, 1, axis=1) * np.roll(share, 2, axis=1)
    return outward / np.linalg.norm(outward, axis=1, keepdims=True)


def integrate_surface_normals(nodes: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """N_i n (N, 3) [m^2] over a whole surface: the integral of grad N_i over the volume (Engelman et al. 1982)."""
    out = np.zeros_like(nodes)
    np.add.at(out, triangles, integrate_facet_normals(nodes, triangles))
    return out
