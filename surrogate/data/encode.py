"""Encoders that compute features of loads, and a reduced basis of displacements."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim.loads import Pushed

from ..array_functions import round_to_half
from .cortex_patch import Patch
from .indentation import IndentationPushes, get_relaxation

Encoder = Callable[[Patch, Pushed], np.ndarray]


def split_forces(pushes: Pushed) -> tuple[np.ndarray, np.ndarray]:
    """Return force magnitudes (B,) [N] and unit directions (B, 3) of pushes; the direction of a zero force is zero."""
    magnitude = np.sqrt(np.einsum("bi,bi->b", pushes.force, pushes.force))
    # The limit is the square root of the smallest number: squares of smaller forces underflow.
    return magnitude, pushes.force / np.maximum(magnitude, np.sqrt(np.finfo(float).tiny))[:, None]


def compute_unit_nodal_forces(patch: Patch, pushes: Pushed) -> np.ndarray:
    """Compute nodal forces (B, 3 m) of the patch for a total of one newton, by FEM's integral over the footprint."""
    weights = patch.contact_surface.find_footprints(pushes.point, pushes.footprint).to_matrix(len(patch.points))
    return distribute_forces(weights.toarray(), pushes)


def compute_root_scaled_forces(patch: Patch, pushes: Pushed) -> np.ndarray:
    """Scale `compute_unit_nodal_forces` by the root of the force, so that products of two scale with force."""
    return scale_by_sqrt_force(compute_unit_nodal_forces(patch, pushes), pushes)


def scale_by_sqrt_force(nodal_forces: np.ndarray, pushes: Pushed) -> np.ndarray:
    """Multiply nodal forces (B, 3 m) for a total of one newton by the square root of each load's force."""
    return np.sqrt(split_forces(pushes)[0])[:, None] * nodal_forces


def distribute_forces(weights: np.ndarray, pushes: Pushed) -> np.ndarray:
    """Distribute one newton of each load by `weights` (B, m) over m nodes; return nodal forces (B, 3 m)."""
    return np.einsum("bm,bi->bmi", weights, split_forces(pushes)[1]).reshape(-1, 3 * weights.shape[1])


def compute_tool_features(patch: Patch, pushes: Pushed) -> np.ndarray:
    """Compute features (B, 8) of loads: point [m], unit direction, force [N] and footprint radius [m].

    For a rod or a blade, (B, 17): also its shaft axis, and the products x_i x_j of its x axis, which do not depend on
    this axis's sign. For relaxing tissue, the last feature is the lost share of the shear resistance.

    The published 13 features describe a load relative to one node (its distance, its angles). A model of all nodes at
    once needs only the load, because the basis contains the positions of the nodes.
    """
    magnitude, direction = split_forces(pushes)
    found = [pushes.point, direction, magnitude, pushes.footprint]
    if isinstance(pushes, IndentationPushes):
        x, first, second = pushes.axes[:, :, 0], *np.triu_indices(3)
        found += [pushes.axes[:, :, 2], x[:, first] * x[:, second]]
    return np.column_stack([*found, *_list_relaxation(pushes)])


def compute_core_features(patch: Patch, pushes: Pushed) -> np.ndarray:
    """Compute features (B, 17) of a rod or a blade: the 8 of a ball, centre of the core [m], tool axes x and z.

    For relaxing tissue, the last feature is the relaxed share, as in `compute_tool_features`.

    Raises
    ------
    TypeError
        The loads are not `Indented`.
    """
    if not isinstance(pushes, IndentationPushes):
        raise TypeError("only rods and blades have a core that stands: give `Indented`.")
    magnitude, direction = split_forces(pushes)
    middle = pushes.point + pushes.force + pushes.offset
    axes = pushes.axes[:, :, 0], pushes.axes[:, :, 2]
    found = [pushes.point, direction, magnitude, pushes.footprint, middle, *axes]
    return np.column_stack([*found, *_list_relaxation(pushes)])


def _list_relaxation(pushes: Pushed) -> list[np.ndarray]:
    """Return a list of the tissue's relaxed shares (B,); empty if the tissue does not relax."""
    known = get_relaxation(pushes)
    return [] if known is None else [known]


ENCODERS: dict[str, Encoder] = {  # Functions from loads to features, by name.
    "nodal": compute_unit_nodal_forces,
    "rooted": compute_root_scaled_forces,
    "tool": compute_tool_features,
    "core": compute_core_features,
}


@dataclass(frozen=True, eq=False)
class Basis:
    """Orthonormal modes of the displacements of some vertices (proper orthogonal decomposition).

    Parameters
    ----------
    nodes
        Mesh vertices (n,) of the modes.
    modes
        Orthonormal modes (r, 3 n) float32.
    """

    nodes: np.ndarray
    modes: np.ndarray

    def encode(self, response: np.ndarray) -> np.ndarray:
        """Project responses (B, n, 3) [m/N] on the modes; return coefficients (B, r)."""
        return response.reshape(len(response), -1) @ self.modes.T

    def decode(self, coefficients: np.ndarray) -> np.ndarray:
        """Compute the responses (B, n, 3) [m/N] that coefficients (B, r) represent."""
        return (coefficients @ self.modes).reshape(len(coefficients), len(self.nodes), 3)


def fit_basis(nodes: np.ndarray, response: np.ndarray, tolerance: float, max_modes: int) -> Basis:
    """Compute a basis of responses (B, n, 3): the fewest modes with a relative error <= `tolerance`, or `max_modes`.

    Errors are measured in the Frobenius norm. The mean is not subtracted, as zero force must give zero motion. If as
    many modes as components are needed, the unit vectors are used as modes.
    """
    matrix = response.reshape(len(response), -1).astype(np.float64)
    _, size, modes = np.linalg.svd(matrix, full_matrices=False)
    left = np.sqrt(np.maximum(0.0, 1.0 - np.cumsum(size**2) / np.sum(size**2)))
    rank = min(max_modes, int(np.searchsorted(-left, -tolerance)) + 1, len(size))
    complete = rank == matrix.shape[1]
    return Basis(nodes, np.eye(rank, dtype=np.float32) if complete else round_to_half(modes[:rank]))
