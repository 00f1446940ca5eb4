"""Arrays of finite elements: node numbers, shape function gradients and quadrature weights."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from ..errors import InputError
from ..geometry.tetmesh import QUADRATIC_EDGES, TetMesh

# Quadrature of degree 3 with eight points, the corners and the face centres. With the four points that suffice
# for small strain, elements under a tool fold at their corners, where there is no point.
EIGHT_POINTS = np.vstack([np.eye(4), (np.ones((4, 4)) - np.eye(4)) / 3.0])
EIGHT_WEIGHTS = np.repeat([1.0 / 40.0, 9.0 / 40.0], 4)  # fractions of the volume

Factors = Callable[[np.ndarray, np.ndarray, np.ndarray], Iterator[tuple[np.ndarray, ...]]]
"""Function that returns pairs of factors, for `_assemble_products`."""


@dataclass(frozen=True, eq=False)
class Elements:
    """Set of T elements with at most n nodes and q quadrature points each.

    `table` (T, n): node numbers. `gradient` (T, q, n, 3): undeformed gradients of the shape functions [1/m]. `weight`
    (T, q): undeformed volume of each quadrature point [m^3]. `nodes`: number of nodes of the discretisation. `owner`
    (T,): mesh tetrahedron whose tissue the element has. `keys` (T, k): vertices and labels that identify each element,
    also after a resection. `sizes` (T,): number of valid entries, at the start, in each row of `table`; None: all.
    """

    table: np.ndarray
    gradient: np.ndarray
    weight: np.ndarray
    node_count: int
    owner: np.ndarray
    keys: np.ndarray
    sizes: np.ndarray | None = None

    def restrict(self, nodes: np.ndarray) -> Elements:
        """Return the elements with node numbers relative to `nodes` (n,), a sorted subset that contains their nodes."""
        return replace(self, table=np.searchsorted(nodes, self.table).astype(self.table.dtype), node_count=len(nodes))


def build_linear_elements(mesh: TetMesh, tet_mask: np.ndarray) -> Elements:
    """Return linear elements with one quadrature point, for the tetrahedra marked in `tet_mask` (T,)."""
    tets = mesh.tets[tet_mask]
    corners = mesh.nodes[tets]
    jacobian = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    inverse = np.linalg.inv(jacobian)  # rows: gradients of barycentric coordinates 1, 2, 3
    gradient = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
    weight = mesh.volumes[tet_mask][:, None]
    return Elements(tets, gradient[:, None], weight, len(mesh.nodes), np.flatnonzero(tet_mask), tets)


def build_quadratic_elements(nodes: np.ndarray, table: np.ndarray, tet_mask: np.ndarray) -> Elements:
    """Return ten-node tetrahedral elements, straight or curved, with eight quadrature points of degree 3.

    Zienkiewicz, Taylor 2005, "The Finite Element Method", section 4.7. nodes (N, 3) [m]; table (T, 10): corners, then
    midpoints of `QUADRATIC_EDGES`; `tet_mask` (T,) selects elements.

    Raises
    ------
    InputError
        The mid-edge nodes fold an element.
    """
    table, slope = table[tet_mask], compute_quadratic_gradients(EIGHT_POINTS)
    jacobian = np.einsum("tai,qaj->tqij", nodes[table], slope)
    volume = np.linalg.det(jacobian)
    folded = np.flatnonzero((volume <= 0.0).any(axis=1))
    if len(folded):
        raise InputError(
            f"quadratic tetrahedron {np.flatnonzero(tet_mask)[folded[0]]} (and {len(folded) - 1} more) is folded over "
            "by its mid-edge nodes: move them towards the middles of their edges."
        )
    gradient = np.einsum("qaj,tqji->tqai", slope, np.linalg.inv(jacobian))
    weight = volume * EIGHT_WEIGHTS / 6.0
    return Elements(table, gradient, weight, len(nodes), np.flatnonzero(tet_mask), table[:, :4])


def pack_gradients(
    domain: np.ndarray, node: np.ndarray, gradient: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `table`, `sizes` and `gradient` of one-point `Elements`, from sums of gradients (m, 3) by domain and node.

    Each domain becomes an element; domain numbers (m,) start at 0 and have no gaps.
    """
    most = int(node.max(initial=0)) + 1
    pair, place = np.unique(domain.astype(np.int64) * most + node, return_inverse=True)
    summed = np.column_stack([np.bincount(place.ravel(), gradient[:, k]) for k in range(3)])
    domain, node = divmod(pair, most)
    size = np.bincount(domain)
    column = np.arange(len(pair)) - np.repeat(np.cumsum(size) - size, size)
    table = np.zeros((len(size), size.max(initial=0)), np.int32)
    table[domain, column] = node
    spread = np.zeros((*table.shape, 3))
    spread[domain, column] = summed
    return table, size.astype(np.int32), spread[:, None]


def compute_quadratic_shapes(barycentric: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return quadratic shape functions (..., n) at barycentric points (..., d): L (2 L - 1) and 4 L_i L_j."""
    middle = 4.0 * barycentric[..., edges[:, 0]] * barycentric[..., edges[:, 1]]
    return np.concatenate([barycentric * (2.0 * barycentric - 1.0), middle], axis=-1)


def compute_quadratic_gradients(barycentric: np.ndarray) -> np.ndarray:
    """Return derivatives (q, 10, 3) of the shape functions by barycentric coordinates 1, 2, 3 at points (q, 4)."""
    slope = np.zeros((len(barycentric), 10, 4))
    slope[:, np.arange(4), np.arange(4)] = 4.0 * barycentric - 1.0
    for place, (i, j) in enumerate(QUADRATIC_EDGES, start=4):
        slope[:, place, i], slope[:, place, j] = 4.0 * barycentric[:, j], 4.0 * barycentric[:, i]
    return slope[:, :, 1:] - slope[:, :, :1]


def assemble_hooke_stiffness(elements: Elements, mu: np.ndarray, lam: np.ndarray) -> sp.csc_array:
    """Assemble the undeformed stiffness (3N, 3N) [N/m] of isotropic elements with Lamé parameters mu, lam (T,) [Pa].

    K = integral of 2 mu E^T E + lambda D^T D, with the operators E of strain and D of volume change: Hughes 2000, "The
    Finite Element Method", section 2.8.
    """

    def build_factors(part: np.ndarray, point: np.ndarray, gradients: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
        for modulus, of in ((2.0 * mu[part], _build_strain), (lam[part], _build_divergence)):
            if modulus.any():
                blocks, weight = of(gradients), (modulus[:, None] * elements.weight[part]).ravel()
                yield blocks, weight[point][:, None, None] * blocks

    return _assemble_products(elements, build_factors)


def assemble_tangent_stiffness(elements: Elements, tangent: np.ndarray) -> sp.csc_array:
    """Assemble the stiffness (3N, 3N) [N/m] from dP/dH (T, q, 9, 9) [Pa]; row and column 3 i + j belong to H_ij.

    K = integral of G^T (dP/dH) G, with the operator G of the displacement gradient H: Bonet, Wood 2008, "Nonlinear
    Continuum Mechanics for Finite Element Analysis", section 9.4.
    """

    def build_factors(part: np.ndarray, point: np.ndarray, gradients: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
        own = (elements.weight[part][..., None, None] * tangent[part]).reshape(-1, 9, 3, 3)
        blocks = (gradients[:, None, :, None] * np.eye(3)[:, None]).reshape(-1, 9, 3)
        x, y, z = (own[..., j][point] * gradients[:, j, None, None] for j in range(3))
        yield blocks, x + y + z

    return _assemble_products(elements, build_factors)


def _assemble_products(elements: Elements, build_factors: Factors, block_size: int = 8_000_000) -> sp.csc_array:
    """Return the symmetric sum (3N, 3N) of A^T B over points, for blocks (M, r, 3) of A and B from `build_factors`.

    Its arguments are elements (T,), and for each of M shape functions the index of its point and its gradient (M, 3).
    Sparse products serve, since elements may have any number of nodes; `block_size` numbers at once limit the memory.
    """
    total = sp.csr_array((3 * elements.node_count,) * 2)
    count, points, most = elements.gradient.shape[:3]
    for part in np.array_split(np.arange(count), max(1, -(-count * points * most * 18 // block_size))):
        table = np.repeat(elements.table[part], points, axis=0)
        size = np.full(len(table), most) if elements.sizes is None else np.repeat(elements.sizes[part], points)
        used = np.arange(most) < size[:, None]
        column, start = table[used], np.append(0, np.cumsum(size))
        slope = elements.gradient[part].reshape(-1, most, 3)[used]
        for factors in build_factors(part, np.repeat(np.arange(len(table)), size), slope):
            shape = factors[0].shape[1] * len(table), 3 * elements.node_count
            left, right = (sp.bsr_array((each, column, start), shape) for each in factors)
            total += (left.T @ right).tocsr()
    return sp.csc_array(total.T)  # symmetric


def _build_divergence(gradients: np.ndarray) -> np.ndarray:
    """Return the blocks (M, 1, 3) of the divergence operator, for shape functions with gradients (M, 3)."""
    return gradients[:, None]


def _build_strain(gradients: np.ndarray) -> np.ndarray:
    """Return the blocks (M, 6, 3) of the small-strain operator in Mandel notation: xx, yy, zz, sqrt(2) yz, xz, xy."""
    blocks = np.zeros((len(gradients), 6, 3))
    for i in range(3):
        blocks[:, i, i] = gradients[:, i]
    for row, (i, j) in enumerate(((1, 2), (0, 2), (0, 1)), start=3):
        blocks[:, row, i], blocks[:, row, j] = np.sqrt(0.5) * gradients[:, j], np.sqrt(0.5) * gradients[:, i]
    return blocks
