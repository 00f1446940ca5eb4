"""Model of strained tissue for live frames on a device, with fixed arrays and recomputed between frames.

The model is that of `strained_descent.py`, but with an explicit matrix M = -(1 + D C)^-1 D for a captured graph.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp

from ..arguments import is_all_finite
from ..discretisation.problem import Problem
from ..linalg.pcg import Preconditioner
from ..runtime.columns import combine_columns
from ..runtime.device import Device
from ..runtime.views import cast_like, get_library, run_in_order, solve_dense, to_library, to_view
from .press_kernel import build_gemv_kernel
from .strained_part import StrainedPart

# Keys of warm-start data.
NODES_KEY, MATRIX_KEY = "bent nodes", "bent matrix"
# Threads that share one row of a matrix product.
ROW_THREADS = 16


@dataclass(frozen=True, eq=False)
class UpdatedModel:
    """Immutable model on the device: `nodes` (1, n) of the mesh, and `matrix` M (1, 3n, 3n) float32 [N/m].

    Unused entries of the matrix are zero.
    """

    nodes: wp.array
    matrix: wp.array

    @property
    def warm_start(self) -> dict[str, np.ndarray]:
        """Entries, by name, for the `warm` data of a solution."""
        return {NODES_KEY: self.nodes.numpy(), MATRIX_KEY: self.matrix.numpy()}


def compute_updated_model(part: StrainedPart, device: Device, u: wp.array) -> UpdatedModel:
    """Return the model of a prepared part at u (3N, 1) [m], for the load case with which the problem has begun.

    The host does not wait for the GPU.
    """
    with run_in_order(device):
        lib, (places, added) = get_library(device), part.find_stiffening(u, np.arange(1), fixed_size=True)
        rows = (3 * places[:, :, None] + cast_like(places, to_library(device, np.arange(3)))).reshape(1, -1)
        own, of = (
            wp.zeros(shape, dtype=dtype, device=device.name)
            for shape, dtype in ((added.shape, wp.float32), (places.shape, wp.int32))
        )
        bent, nodes = to_view(own), to_view(of)
        added = cast_like(bent, added)
        system = added @ cast_like(bent, part.build_compliance(rows))
        diagonal = range(rows.shape[1])
        system[:, diagonal, diagonal] += 1.0
        matrix = -solve_dense(system, added)
        bent[:] = lib.where(lib.isfinite(matrix).all(), 0.5 * (matrix + matrix.mT), 0.0 * added)
        nodes[:] = cast_like(nodes, to_library(device, part.compliance.nodes))[places]
        return UpdatedModel(of, own)


def restore_updated_model(warm: Mapping[str, np.ndarray], device: Device, count: int, size: int) -> UpdatedModel | None:
    """Return the model for `count` nodes from warm-start data; None if missing or not of size 3n = `size`."""
    if NODES_KEY not in warm or MATRIX_KEY not in warm:
        return None
    nodes, matrix = np.asarray(warm[NODES_KEY]), np.asarray(warm[MATRIX_KEY])
    if nodes.shape != (1, size // 3) or matrix.shape != (1, size, size) or nodes.dtype.kind != "i":
        return None
    if matrix.dtype != np.float32 or not is_all_finite(matrix) or (nodes < 0).any() or (nodes >= count).any():
        return None
    return UpdatedModel(device.upload(nodes, wp.int32), device.upload(matrix, wp.float32))


class UpdatedPreconditioner:
    """Preconditioner of single load cases: inverse of the undeformed stiffness, updated by the loaded model.

    Parameters
    ----------
    base
        Inverse of the undeformed stiffness.
    problem
        Problem of this stiffness.
    size
        Number of rows 3n of the models.
    """

    def __init__(self, base: Preconditioner, problem: Problem, size: int):
        self._rest, self._problem, self.on_device = base, problem, base.on_device
        name = problem.device.name
        self._nodes = wp.zeros((1, size // 3), dtype=wp.int32, device=name)
        self._matrix = wp.zeros((1, size, size), dtype=wp.float32, device=name)
        self._pull, self._more = (problem.device.allocate(problem.rows, 1) for _ in range(2))

    def load_model(self, model: UpdatedModel | None) -> None:
        """Load another model; None: use the undeformed stiffness."""
        if model is None:
            self._matrix.zero_()
        else:
            wp.copy(self._nodes, model.nodes)
            wp.copy(self._matrix, model.matrix)

    def prepare(self, problem: Problem, columns: int) -> None:
        """Prepare the preconditioner of the undeformed mesh."""
        self._rest.prepare(problem, columns)

    def apply(self, r: wp.array, case_mask: np.ndarray, out: wp.array) -> None:
        """Apply the undeformed inverse to r, then to the forces that the model adds."""
        device = self._problem.device
        self._rest.apply(r, case_mask, out)
        self._pull.zero_()
        kernel, shape = (
            build_gemv_kernel(device, wp.float32, device.scalar, ROW_THREADS),
            (ROW_THREADS, *self._matrix.shape[:2]),
        )
        device.launch(kernel, shape, [self._matrix, self._nodes, out], [self._pull])
        self._problem.constraint.project_nodes(self._pull)
        self._rest.apply(self._pull, case_mask, self._more)
        combine_columns(device, out, 1.0, self._more, out)
