"""Second-order response of a model to nodal forces, for each pair of components, exact up to round-off.

With internal forces f(u) = K u + Q(u, u) + ..., Q(u, v) = integral of B^T P2(Bu, Bv), forces F displace the model by
K^-1 F - K^-1 Q(K^-1 F, K^-1 F) + ... P2 is half of the second derivative of the stress in the undeformed state. This
module computes the second term for pairs of unit forces, element by element; `power_series` computes this term for
one load only.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import Any

import numpy as np
import scipy.sparse as sp

from ..discretisation.element import Elements
from ..discretisation.problem import Problem
from ..discretisation.term import StrainTerm
from ..runtime.threads import choose_threads, run_concurrently
from ..runtime.views import run_in_order, to_host, to_library

CPU_BATCH = 256  # Elements of one batch on the CPU: the data of a pair fit into the cache of a core.
CUDA_BATCH = 4096  # The same on CUDA: they fill a GPU.


@dataclass(frozen=True, eq=False)
class ElementBatch:
    """Batch of elements of one tissue: indices (k,), and P2 (9, 81) float32, which maps a strain to a stiffness."""

    elements: Elements
    element_numbers: np.ndarray
    tensor: np.ndarray


def compute_second_order(
    problem: Problem,
    unit_motions: np.ndarray,
    functionals: np.ndarray,
    pair_mask: np.ndarray,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs (P, 2) of force components p <= q, and the second-order response (P, r) float32 to each pair.

    Under forces F (3m,), the second order is the sum over pairs (p, q) of F_p F_q times the row (r,) of the pair.

    Parameters
    ----------
    problem
        Problem whose elastic terms are used.
    unit_motions
        Displacements (3m, 3N) [m/N] under unit forces on m nodes: rows of the undeformed compliance.
    functionals
        Products (r, 3N) of compliance and weights of the functionals, as `OutputFunctionals.solutions`.
    pair_mask
        Symmetric mask (m, m) of the node pairs for which the response is requested.
    progress
        Function called with the number of finished batches of elements and the total number.
    """
    device = problem.device
    first, second = np.nonzero(np.triu(np.repeat(np.repeat(pair_mask, 3, axis=0), 3, axis=1)))
    start = np.searchsorted(first, np.arange(len(unit_motions) + 1))
    terms = [term for term in problem.terms if isinstance(term, StrainTerm)]
    work = [
        one
        for term in terms
        for one in _list_batches(*term.compute_second_order(), CUDA_BATCH if device.on_cuda else CPU_BATCH)
    ]
    others, done = to_library(device, second), count(1)
    tasks = 1 if device.on_cuda else choose_threads(sum(len(each.element_numbers) for each in work))
    tables = [to_library(device, np.zeros((len(first), len(functionals)), np.float32)) for _ in range(tasks)]

    def add_batches(table: Any, batches: list[ElementBatch]) -> None:
        for batch in batches:
            add_batch(table, batch)
            progress(next(done), len(work))

    def add_batch(table: Any, batch: ElementBatch) -> None:
        gradient = _build_gradient_matrix(batch.elements, batch.element_numbers)
        weight = np.repeat(batch.elements.weight[batch.element_numbers].ravel(), 9)[:, None]
        strain = to_library(device, (gradient @ unit_motions.T).astype(np.float32).reshape(-1, 9, len(unit_motions)))
        lever = to_library(device, (weight * (gradient @ functionals.T)).astype(np.float32))
        tensor = to_library(device, batch.tensor)
        for component in np.flatnonzero(np.diff(start)).tolist():
            rows = slice(int(start[component]), int(start[component + 1]))
            stiffening = (strain[:, :, component] @ tensor).reshape(-1, 9, 9)
            stress = stiffening @ strain[:, :, others[rows]]
            table[rows] -= stress.reshape(len(lever), -1).T @ lever

    with run_in_order(device):
        run_concurrently([partial(add_batches, table, work[k::tasks]) for k, table in enumerate(tables)])
        table = to_host(sum(tables[1:], tables[0]))
    twice = np.where(first == second, 1.0, 2.0).astype(np.float32)
    return np.column_stack([first, second]), table * twice[:, None]


def _list_batches(elements: Elements, tensors: np.ndarray, tissues: np.ndarray, size: int) -> list[ElementBatch]:
    """Return all elements of a term, in batches of one tissue and at most `size` elements."""
    found = []
    for each, tensor in enumerate(tensors):
        chosen = np.flatnonzero(tissues == each)
        flat = tensor.transpose(1, 0, 2).reshape(9, 81).astype(np.float32)
        found += [ElementBatch(elements, chosen[k : k + size], flat) for k in range(0, len(chosen), size)]
    return found


def _build_gradient_matrix(elements: Elements, element_numbers: np.ndarray) -> sp.csr_array:
    """Return the matrix from displacements (3N,) to gradients (9 k q,), row by row, of `element_numbers` (k,)."""
    table, slope = elements.table[element_numbers], elements.gradient[element_numbers]
    count, points, most = slope.shape[:3]
    row = np.arange(9 * count * points).reshape(count, points, 1, 3, 3)
    column = 3 * table[:, None, :, None, None] + np.arange(3)[:, None]
    shape = count, points, most, 3, 3
    value = np.broadcast_to(slope[:, :, :, None, :], shape).ravel()
    place = np.broadcast_to(row, shape).ravel(), np.broadcast_to(column, shape).ravel()
    return sp.csr_array(sp.coo_array((value, place), shape=(9 * count * points, 3 * elements.node_count)))
