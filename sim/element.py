"""Finite elements as tables: node numbers, shape gradients and quadrature weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from .mesh import TetMesh


@dataclass(frozen=True, eq=False)
class Elements:
    """T elements of n nodes with q quadrature points.

    table (T, n) node numbers; gradient (T, q, n, 3) of the shape functions in the rest configuration [1/m];
    weight (T, q) rest volume of each quadrature point [m^3]; nodes, how many nodes the discretisation has.
    """

    table: np.ndarray
    gradient: np.ndarray
    weight: np.ndarray
    nodes: int


def linear_elements(mesh: TetMesh, chosen: np.ndarray) -> Elements:
    """Linear tetrahedra: one quadrature point, gradients constant. `chosen` (T,) bool picks elements."""
    tets = mesh.tets[chosen]
    corners = mesh.nodes[tets]
    jacobian = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    inverse = np.linalg.inv(jacobian)  # rows: gradients of barycentric coordinates 1, 2, 3
    gradient = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
    return Elements(tets, gradient[:, None], mesh.volumes[chosen][:, None], len(mesh.nodes))


def hooke_stiffness(elements: Elements, mu: np.ndarray, lam: np.ndarray) -> sp.csc_array:
    """Stiffness at rest (3N, 3N) [N/m] of isotropic elements with Lamé's mu, lam (T,) [Pa].

    K_ab = integral of mu (g_a . g_b I + g_b (x) g_a) + lambda g_a (x) g_b.
    """
    count, size = elements.table.shape
    g, w = elements.gradient, elements.weight
    dots = np.einsum("tq,tqai,tqbi->tab", w, g, g)
    outer = np.einsum("tq,tqai,tqbj->taibj", w, g, g)
    blocks = lam[:, None, None, None, None] * outer
    blocks += mu[:, None, None, None, None] * (
        np.einsum("tab,ij->taibj", dots, np.eye(3)) + outer.transpose(0, 1, 4, 3, 2)
    )
    dof = (3 * elements.table[:, :, None] + np.arange(3)).reshape(count, 3 * size)
    row = np.repeat(dof, 3 * size, axis=1).ravel()
    column = np.tile(dof, (1, 3 * size)).ravel()
    return sp.csc_array(sp.coo_array((blocks.ravel(), (row, column)), shape=(3 * elements.nodes,) * 2))
