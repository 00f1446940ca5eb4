"""Features of loads, and a reduced basis of displacements."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim.loads import Pushed

from ..array_functions import round_to_half
from .cortex_patch import Patch
from .indentation import Indented, get_relaxation

Encoder = Callable[[Patch, Pushed], np.ndarray]


def split_forces(pushes: Pushed) -> tuple[np.ndarray, np.ndarray]:
    """Return force magnitudes (B,) [N] and unit directions (B, 3); the direction of zero force is zero."""
    magnitude = np.sqrt(np.einsum("bi,bi->b", pushes.force, pushes.force))
    # The root of the smallest number: squares of smaller forces underflow.
    return magnitude, pushes.force / np.maximum(magnitude, np.sqrt(np.finfo(float).tiny))[:, None]


def compute_unit_nodal_forces(patch: Patch, pushes: Pushed) -> np.ndarray:
    """Compute forces (B, 3 m) at the patch's nodes, for one newton, by the FEM's own integral over the footprint."""
    weights = patch.contact_surface.find_footprints(pushes.point, pushes.footprint).to_matrix(len(patch.points))
    return distribute_forces(weights.toarray(), pushes)


def compute_root_scaled_forces(patch: Patch, pushes: Pushed) -> np.ndarray:
    """Scale `compute_unit_nodal_forces` by the root of the force: products of two are products of forces per newton."""
    return scale_by_root_force(compute_unit_nodal_forces(patch, pushes), pushes)


def scale_by_root_force(nodal_forces: np.ndarray, pushes: Pushed) -> np.ndarray:
    """Multiply shares (B, 3 m) for one newton by the root of each load's force."""
    return np.sqrt(split_forces(pushes)[0])[:, None] * nodal_forces


def distribute_forces(weights: np.ndarray, pushes: Pushed) -> np.ndarray:
    """Compute forces (B, 3 m) at m nodes, for one newton, distributed by weights (B, m)."""
    return np.einsum("bm,bi->bmi", weights, split_forces(pushes)[1]).reshape(-1, 3 * weights.shape[1])


def compute_tool_features(patch: Patch, pushes: Pushed) -> np.ndarray:
    """Compute point [m], unit direction, force [N] and footprint radius [m]: (B, 8).

    A rod or a blade adds its shaft, and the products x_i x_j of its other axis, which do not depend on the axis's sign:
    (B, 17). For relaxing tissue, the last feature is the lost share of the resistance to a change of shape.

    The published 13 features describe the load relative to one node (its distance, its angles). A model of all nodes at
    once needs the load alone, because the basis holds the positions of the nodes.
    """
    magnitude, direction = split_forces(pushes)
    found = [pushes.point, direction, magnitude, pushes.footprint]
    if isinstance(pushes, Indented):
        x, first, second = pushes.axes[:, :, 0], *np.triu_indices(3)
        found += [pushes.axes[:, :, 2], x[:, first] * x[:, second]]
    return np.column_stack([*found, *_list_relaxation(pushes)])


def compute_core_features(patch: Patch, pushes: Pushed) -> np.ndarray:
    """Compute a rod's or blade's pose (B, 17): `compute_tool_features` of a ball, centre of its core [m], axes x and z.

    For relaxing tissue, the last feature is that of `compute_tool_features`.

    Raises
    ------
    TypeError
        Loads that are not `Indented`.
    """
    if not isinstance(pushes, Indented):
        raise TypeError("only rods and blades have a core that stands: give `Indented`.")
    magnitude, direction = split_forces(pushes)
    middle = pushes.point + pushes.force + pushes.offset
    axes = pushes.axes[:, :, 0], pushes.axes[:, :, 2]
    found = [pushes.point, direction, magnitude, pushes.footprint, middle, *axes]
    return np.column_stack([*found, *_list_relaxation(pushes)])


def _list_relaxation(pushed: Pushed) -> list[np.ndarray]:
    """Return a list with the relaxed share (B,) of the tissue; an empty list if it does not relax."""
    known = get_relaxation(pushed)
    return [] if known is None else [known]


ENCODERS: dict[str, Encoder] = {  # Functions from loads to features, by name.
    "nodal": compute_unit_nodal_forces,
    "rooted": compute_root_scaled_forces,
    "tool": compute_tool_features,
    "core": compute_core_features,
}


@dataclass(frozen=True, eq=False)
class Basis:
    """Orthonormal modes of the response of some vertices (proper orthogonal decomposition).

    Parameters
    ----------
    nodes
        Mesh vertices (n,).
    modes
        Modes (r, 3 n) float32.
    """

    nodes: np.ndarray
    modes: np.ndarray

    def encode(self, response: np.ndarray) -> np.ndarray:
        """Compute coefficients (B, r) of responses (B, n, 3) [m/N]."""
        return response.reshape(len(response), -1) @ self.modes.T

    def decode(self, coefficients: np.ndarray) -> np.ndarray:
        """Compute responses (B, n, 3) [m/N] from coefficients (B, r)."""
        return (coefficients @ self.modes).reshape(len(coefficients), len(self.nodes), 3)


def fit_basis(nodes: np.ndarray, response: np.ndarray, tolerance: float, max_modes: int) -> Basis:
    """Compute the fewest modes, up to `max_modes`, with a relative error <= `tolerance` of responses (B, n, 3).

    Errors are Frobenius norms. The mean is not subtracted: zero force must give zero motion. If as many modes as
    components are needed, the modes are the components.
    """
    matrix = response.reshape(len(response), -1).astype(np.float64)
    _, size, modes = np.linalg.svd(matrix, full_matrices=False)
    left = np.sqrt(np.maximum(0.0, 1.0 - np.cumsum(size**2) / np.sum(size**2)))
    rank = min(max_modes, int(np.searchsorted(-left, -tolerance)) + 1, len(size))
    complete = rank == matrix.shape[1]
    return Basis(nodes, np.eye(rank, dtype=np.float32) if complete else round_to_half(modes[:rank]))
