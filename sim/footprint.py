"""A round tool on a triangulated surface: how its weight falls on the mesh's vertices.

The traction w(s) = sqrt(1 - s^2), s = |x - c| / r, is that of a flat punch's smooth counterpart (Hertz), integrated
over triangles subdivided until they are small against the footprint: force and moment do not depend on the mesh.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from .element import quadratic_shapes
from .errors import InputError
from .mesh import TRIANGLE_EDGES

# Triangles are divided until their longest edge is below this share of the footprint's radius.
FINENESS = 0.12
PIECES = 8


def barycentric_lattice(rows: int) -> np.ndarray:
    """Corner coordinates (rows^2, 3) of the centres of a triangle's equal pieces, `rows` along each edge."""
    upright = [(i + 1.0 / 3.0, j + 1.0 / 3.0) for i in range(rows) for j in range(rows - i)]
    turned = [(i + 2.0 / 3.0, j + 2.0 / 3.0) for i in range(rows - 1) for j in range(rows - 1 - i)]
    share = np.array(upright + turned) / rows
    return np.column_stack([1.0 - share.sum(axis=1), share])


LATTICE = barycentric_lattice(PIECES)


def footprint_weights(nodes: np.ndarray, triangles: np.ndarray, points: np.ndarray, radii: np.ndarray) -> sp.csr_array:
    """Weights (B, V), each row summing to one: a force F at `points` (B, 3) puts weight x F on every vertex.

    Parameters
    ----------
    nodes
        (V, 3) [m].
    triangles
        (S, 3), or (S, 6) with the middles of `TRIANGLE_EDGES` if quadratic: where the tool may touch. The corners say
        where they lie.
    points, radii
        (B, 3) and (B,) [m]. A point off the surface is moved to its nearest point on it, by at most its radius.

    Raises
    ------
    InputError
        A footprint that does not touch the surface.
    """
    corners = nodes[triangles[:, :3]]
    centre = corners.mean(axis=1)
    reach = np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)
    columns, values, ends = [np.zeros(0, int)], [np.zeros(0)], [0]
    for number, (point, radius) in enumerate(zip(points, radii, strict=True)):
        near = np.flatnonzero(np.linalg.norm(centre - point, axis=1) <= reach + radius)
        touched = nearest_on(corners[near], point) if len(near) else None
        if touched is None or np.linalg.norm(touched - point) > radius:
            raise InputError(
                f"load {number} presses at {np.round(1e3 * point, 1)} mm with a footprint of {1e3 * radius:.3g} mm, "
                "which does not touch the surface: choose a point on it."
            )
        near = np.flatnonzero(np.linalg.norm(centre - touched, axis=1) <= reach + radius)
        weight = _integrate(corners[near], touched, radius, triangles.shape[1])
        vertices, place = np.unique(triangles[near], return_inverse=True)
        total = np.bincount(place.ravel(), weight.ravel())
        loaded = total != 0.0
        columns.append(vertices[loaded])
        values.append(total[loaded] / weight.sum())
        ends.append(ends[-1] + int(loaded.sum()))
    return sp.csr_array((np.concatenate(values), np.concatenate(columns), ends), shape=(len(points), len(nodes)))


def nearest_on(corners: np.ndarray, point: np.ndarray) -> np.ndarray:
    """The point (3,) nearest to `point` (3,) on triangles with `corners` (S, 3, 3) [m].

    Ericson 2005, "Real-Time Collision Detection", section 5.1.5: the plane's foot where it lies inside, else the
    nearest of the three edges.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    first, second, offset = b - a, c - a, point - a
    # Corner coordinates of the foot from the Gram matrix of two edges.
    aa, ab, bb = (
        np.einsum("si,si->s", one, other) for one, other in ((first, first), (first, second), (second, second))
    )
    pa, pb = np.einsum("si,si->s", offset, first), np.einsum("si,si->s", offset, second)
    with np.errstate(divide="ignore", invalid="ignore"):  # a needle has no foot to round-off: its edges serve
        v, w = (bb * pa - ab * pb) / (aa * bb - ab * ab), (aa * pb - ab * pa) / (aa * bb - ab * ab)
        foot = a + v[:, None] * first + w[:, None] * second
        inside = (v >= 0.0) & (w >= 0.0) & (v + w <= 1.0)
    candidates = []
    for start, end in ((a, b), (b, c), (c, a)):
        edge = end - start
        along = np.einsum("si,si->s", point - start, edge) / np.einsum("si,si->s", edge, edge)
        candidates.append(start + along.clip(0.0, 1.0)[:, None] * edge)
    candidates.append(foot[inside])
    nearest = np.concatenate(candidates)
    return nearest[np.argmin(np.linalg.norm(nearest - point, axis=1))]


def _integrate(corners: np.ndarray, point: np.ndarray, radius: float, size: int) -> np.ndarray:
    """Integral of w N_a over the footprint (S, size), up to a factor, by one point per subdivided triangle.

    N_a are the shape functions of triangles of `size` 3 or 6 nodes.

    Triangles are quartered until a lattice of `PIECES` rows is fine enough, so that a small tool on a large triangle
    costs no more than a large tool on small ones.
    """
    out = np.zeros((len(corners), size))
    owner = np.arange(len(corners))
    bary = np.broadcast_to(np.eye(3), (len(corners), 3, 3))  # corner coordinates of each piece within its owner
    while len(owner):
        at = bary @ corners[owner] - point
        edges = at - at[:, [2, 0, 1]]
        longest = np.sqrt(np.einsum("pci,pci->pc", edges, edges).max(axis=1))
        centre = at.mean(axis=1)
        inside = np.sqrt(np.einsum("pi,pi->p", centre, centre)) <= radius + longest
        small = longest <= PIECES * FINENESS * radius
        done = small & inside
        area = np.linalg.norm(np.cross(edges[done, 0], edges[done, 1]), axis=1)
        samples = LATTICE @ at[done]
        share = np.einsum("pqi,pqi->pq", samples, samples) / radius**2
        weight = area[:, None] * np.sqrt(np.clip(1.0 - share, 0.0, None))
        if size == 3:  # linear in the corner coordinates: they may be summed first
            np.add.at(out, owner[done], np.einsum("pa,pab->pb", weight @ LATTICE, bary[done]))
        else:
            shape = quadratic_shapes(LATTICE @ bary[done], TRIANGLE_EDGES)
            np.add.at(out, owner[done], np.einsum("pq,pqa->pa", weight, shape))
        split = inside & ~small
        owner = np.repeat(owner[split], 4)
        bary = _quartered(bary[split])
    return out


def _quartered(bary: np.ndarray) -> np.ndarray:
    """Each triangle (n, 3, 3) cut at its mid-edges: (4n, 3, 3)."""
    a, b, c = bary[:, 0], bary[:, 1], bary[:, 2]
    ab, bc, ca = (a + b) / 2.0, (b + c) / 2.0, (c + a) / 2.0
    pieces = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (bc, ca, ab)]
    return np.stack([np.stack(piece, axis=1) for piece in pieces], axis=1).reshape(-1, 3, 3)
