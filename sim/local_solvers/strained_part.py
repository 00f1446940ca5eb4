"""Model of the inverse stiffness with strained tissue: tangent stiffness in strained tissue, else undeformed stiffness.

    (K0 + E D E')^-1 = H + H E M E' H,    M = -(1 + D C)^-1 D,    H = K0^-1,  C = E' H E:

Woodbury 1950. D is the tangent stiffness minus the undeformed stiffness of strained elements, on their nodes only.
Under a deep press, K0 is a third of the actual stiffness, and a step with K0 is three times too long.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ..discretisation.problem import Problem
from ..discretisation.term import StrainTerm
from ..linalg.compliance import Compliance
from ..runtime.device import Device
from ..runtime.views import (
    cast_like,
    from_view,
    get_library,
    pad_zeros,
    rank_rows,
    sort_columns,
    to_host,
    to_library,
    to_view,
)
from .press_kernel import build_gemv_kernel


@dataclass(frozen=True)
class StrainLimits:
    """Limits of a model of strained tissue.

    Parameters
    ----------
    min_strain
        Norm |H| of the displacement gradient below which the undeformed stiffness is used.
    max_nodes
        Maximum number of nodes of a model; nodes with the largest |H| have priority.
    max_candidates
        Maximum number of candidate nodes: the touchable nodes and the nearest nodes to these. The compliance has three
        rows per candidate node.
    max_cases
        Largest batch with models; larger batches use L-BFGS pairs. Models would not be faster there: a launch lasts as
        long as its slowest load case, and a better model makes the contact forces harder to solve.
    max_bytes
        Maximum memory of the matrices inverted together [bytes].
    """

    min_strain: float = 0.1
    max_nodes: int = 1600
    max_candidates: int = 1600
    max_cases: int = 4
    max_bytes: int = 2**31


STRAIN_LIMITS = StrainLimits()  # Default.


@dataclass(frozen=True, eq=False)
class StrainedModel:
    """Models of b load cases as updates of the undeformed compliance, in arrays of `views.get_library`.

    `nodes` (b, k) are indices into the compliance. `matrix` (b, 3k, 3k) is M [N/m], with zeros if a load case has fewer
    nodes. `own` (b, 3n, 3n) [m/N] is the change of the compliance between the n touchable nodes.
    """

    nodes: Any
    matrix: Any
    change: Any

    @property
    def has_strained_nodes(self) -> bool:
        """True if any load case has strained nodes."""
        return self.nodes.shape[1] > 0

    @property
    def is_strained(self) -> np.ndarray:
        """Mask (b,) of the load cases with strained nodes."""
        return to_host((self.matrix != 0.0).any(-1).any(-1))

    def select(self, columns: np.ndarray) -> StrainedModel:
        """Return the models of the load cases `columns` (k,)."""
        return StrainedModel(self.nodes[columns], self.matrix[columns], self.change[columns])

    def reset_columns(self, columns: np.ndarray) -> None:
        """Reset the models of the load cases `columns` (k,) to the undeformed stiffness."""
        self.matrix[columns], self.change[columns] = 0.0, 0.0

    def merge_columns(self, columns: np.ndarray, new_models: StrainedModel) -> StrainedModel:
        """Return the models, with those of the load cases `columns` (k,) replaced by `new_models`."""
        most = max(self.nodes.shape[1], new_models.nodes.shape[1])
        mine, its = self._pad_nodes(most), new_models._pad_nodes(most)
        for one, two in ((mine.nodes, its.nodes), (mine.matrix, its.matrix), (mine.change, its.change)):
            one[columns] = two
        return mine

    def _pad_nodes(self, node_count: int) -> StrainedModel:
        """Return the models padded to `node_count` nodes."""
        missing = node_count - self.nodes.shape[1]
        nodes, matrix = pad_zeros(self.nodes, (missing,)), pad_zeros(self.matrix, (3 * missing, 3 * missing))
        return StrainedModel(nodes, matrix, self.change)

    def apply_stiffness(self, device: Device, motion: wp.array) -> wp.array:
        """Return E M E' motion (3n, b) [N], for motions (3n, b) [m] of the nodes of the compliance."""
        out, (count, size) = wp.zeros_like(motion), self.matrix.shape[:2]
        inputs = [from_view(device, self.matrix), from_view(device, self.nodes), motion]
        device.launch(build_gemv_kernel(device, wp.float64, wp.float64), (1, count, size), inputs, [out])
        return out


def choose_strained_rows(device: Device, strain: Any, min_strain: float, max_rows: int) -> tuple[Any, Any, Any]:
    """Return up to `max_rows` rows with the largest strains (n, b) above `min_strain` per load case, sorted: (m, b).

    The value n marks unused entries. Also return the strain (b,) above which rows are chosen, and their number (b,).
    """
    lib, count = get_library(device), len(strain)
    columns, order = to_library(device, np.arange(strain.shape[1])), rank_rows(strain)
    limit = 0.0 * strain[0] + min_strain
    if count > max_rows:
        limit = lib.maximum(limit, strain[order[max_rows], columns])
    kept = strain[order[:max_rows], columns] > limit
    return sort_columns(lib.where(kept, order[:max_rows], count)), limit, kept.sum(0)


class StrainedPart:
    """Builder of models of strained tissue for one problem.

    Parameters
    ----------
    problem
        Problem of the tissue.
    compliance
        Compliance at the touchable nodes, followed by the nearest other nodes.
    touchable
        Number of touchable nodes.
    strains
        Limits of the models.
    """

    def __init__(self, problem: Problem, compliance: Compliance, touchable: int, strains: StrainLimits = STRAIN_LIMITS):
        device, nodes = problem.device, compliance.nodes
        self._problem, self.compliance, self._touchable, self._strains = problem, compliance, touchable, strains
        self.size = 3 * min(strains.max_nodes, len(nodes))
        """Number of rows of the largest model."""
        self._near = device.upload(nodes, wp.int32)
        near = np.zeros(problem.rows // 3, bool)
        near[nodes] = True
        found = [(term, term.find_elements_on(near)) for term in problem.terms if isinstance(term, StrainTerm)]
        self._elements = [(term, device.upload(some, wp.int32)) for term, some in found]

    def build_model(self, u: wp.array, columns: np.ndarray) -> StrainedModel:
        """Return models of the load cases `columns` (k,) at u (3N, b) [m]."""
        return self._build_models(*self.find_stiffening(u, columns))

    def prepare(self) -> None:
        """Compute the compliance at all nodes, unless already computed."""
        self.compliance.ensure_columns(np.ones(len(self.compliance.nodes), bool))

    def find_stiffening(self, u: wp.array, columns: np.ndarray, fixed_size: bool = False) -> tuple[Any, Any]:
        """Return the most strained nodes as indices (k, n) into the compliance, and their matrices D (k, 3n, 3n) [N/m].

        D has zeros if a load case has fewer nodes. If `fixed_size`, n is the maximum, and the host does not wait for
        the GPU.
        """
        device, count, strains = self._problem.device, len(columns), self._strains
        picked = device.upload(columns, wp.int32)
        strain = device.allocate(self._problem.rows // 3, count)
        for term, some in self._elements:
            term.update_max_strain(some, u, picked, strain)
        nodes, limit, numbers = choose_strained_rows(
            device, to_view(strain)[to_view(self._near)], strains.min_strain, strains.max_nodes
        )
        wide = len(nodes) if fixed_size else int(numbers.max())
        place = wp.full((len(strain), count), -1, dtype=wp.int32, device=device.name)
        near, axes = len(self._near), to_library(device, np.arange(max(wide, count), dtype=np.int32))
        ranks = to_view(wp.full((near + 1, count), -1, dtype=wp.int32, device=device.name))
        ranks[nodes[:wide], axes[:count]] = axes[:wide, None]
        to_view(place)[to_view(self._near)] = ranks[:near]
        stiffer = wp.zeros((count, 3 * wide, 3 * wide), dtype=wp.float64, device=device.name)
        if wide:
            for term, some in self._elements:
                term.add_stiffening(some, u, picked, from_view(device, limit), place, stiffer)
        return cast_like(ranks, nodes[:wide].T.clip(max=near - 1)), to_view(stiffer)

    def build_compliance(self, rows: Any) -> Any:
        """Return the symmetrised compliance C (b, n, n) [m/N] between computed `rows` (b, n)."""
        between = self.compliance.columns[rows[:, :, None], rows[:, None, :]]
        return 0.5 * (between + between.mT)

    def _build_models(self, nodes: Any, stiffness_changes: Any) -> StrainedModel:
        """Return the models from matrices D (b, 3k, 3k) [N/m] on `nodes` (b, k) of the compliance."""
        self.prepare()
        device, count, size = self._problem.device, len(nodes), stiffness_changes.shape[1]
        # One more row and column collect the entries of nodes that cannot be touched.
        shape = count, 3 * self._touchable + 1, 3 * self._touchable + 1
        own = to_view(wp.zeros(shape, dtype=wp.float32, device=device.name))
        matrix, axes = 0.0 * stiffness_changes, to_library(device, np.arange(3))
        each = max(1, self._strains.max_bytes // (6 * 8 * max(size, 1) ** 2))
        for first in range(0, count if size else 0, each):
            some = slice(first, first + each)
            rows = (3 * nodes[some][:, :, None] + axes).reshape(-1, size)
            soft = self.build_compliance(rows)
            system = stiffness_changes[some] @ soft
            diagonal = range(size)
            system[:, diagonal, diagonal] += 1.0
            try:
                found = get_library(device).linalg.solve(system, stiffness_changes[some])
            except get_library(device).linalg.LinAlgError:
                continue  # keep the undeformed stiffness
            matrix[some] = -0.5 * (found + found.mT)
            # Touchable nodes come first in every list of nodes.
            most = 3 * int((nodes[some] < self._touchable).sum(-1).max())
            reach = soft[:, :, :most]
            place = rows[:, :most].clip(max=own.shape[1] - 1)
            columns = cast_like(nodes, to_library(device, np.arange(count)))[some][:, None, None]
            own[columns, place[:, :, None], place[:, None, :]] = cast_like(own, reach.mT @ (matrix[some] @ reach))
        return StrainedModel(nodes, matrix, own)
