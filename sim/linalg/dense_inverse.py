"""Preconditioner on CUDA for meshes of a few thousand nodes: dense inverse of the undeformed stiffness.

One matrix product solves a whole batch of load cases, while triangular solves would leave the GPU idle. In a
single-precision solver the inverse is stored in half precision, which tensor cores multiply at full rate. After scaling
the matrix to a unit diagonal and each right-hand side to unit length, values fit the range of half precision. Eleven
bits resolve the stiff modes (the eight bits of bfloat16 do not, at nu = 0.49). Of the preconditioners only this module
uses torch, for matrix products; only `preconditioner` imports this module, if the inverse is chosen.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
import warp as wp

from ..discretisation.problem import Problem
from ..runtime.columns import add_dots, is_workspace_width
from ..runtime.device import Device, forward_kernel
from . import block_inverse
from .half_symv import add_product, list_tiles

TILE = 64  # Tensor cores need rows and columns in multiples of this.
ROWS_PER_THREAD = 8  # Rows per thread.
# Type of the stored matrix, for each precision of the solver.
LOW_TYPES = {"float32": wp.float16, "float64": wp.float64}


def can_invert(rows: int, device: Device) -> bool:
    """Return True if the GPU can invert `rows` unknowns in time, and store the inverse."""
    return block_inverse.can_invert(rows, wp.device_to_torch(device.name), estimate_inverse_bytes(rows, device))


def estimate_inverse_bytes(rows: int, device: Device) -> int:
    """Return the estimated memory of the inverse of `rows` unknowns [bytes]."""
    return wp.types.type_size_in_bytes(LOW_TYPES[device.precision]) * rows**2


@cache
def build_kernels(device: Device, dtype: Any, rows_per_thread: int) -> tuple[wp.Kernel, wp.Kernel]:
    """Return two kernels that map to the unknowns of the matrix, in type `dtype`, and back to the mesh."""
    scalar = device.scalar

    @forward_kernel(module="unique")
    def restrict(
        row_start: wp.array(dtype=wp.int32),
        column: wp.array(dtype=wp.int32),
        value: wp.array(dtype=scalar),
        scale: wp.array(dtype=scalar),
        square_norm: wp.array(dtype=wp.float64),
        r: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=dtype),
    ):
        """Compute out_i = scale_i (L^T r)_i / |r|."""
        block, c = wp.tid()
        size = scalar(wp.sqrt(square_norm[c]))
        share = wp.where(size > scalar(0.0), scalar(1.0) / size, scalar(0.0))
        for j in range(rows_per_thread):
            i = rows_per_thread * block + j
            if i < scale.shape[0]:
                total = scalar(0.0)
                for k in range(row_start[i], row_start[i + 1]):
                    total += value[k] * r[column[k], c]
                out[i, c] = dtype(share * scale[i] * total)

    @forward_kernel(module="unique")
    def extend(
        row_start: wp.array(dtype=wp.int32),
        column: wp.array(dtype=wp.int32),
        value: wp.array(dtype=scalar),
        square_norm: wp.array(dtype=wp.float64),
        solution: wp.array2d(dtype=dtype),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Compute out_r = |r| (L x)_r."""
        block, c = wp.tid()
        size = scalar(wp.sqrt(square_norm[c]))
        for j in range(rows_per_thread):
            r = rows_per_thread * block + j
            if r < out.shape[0]:
                total = scalar(0.0)
                for k in range(row_start[r], row_start[r + 1]):
                    total += value[k] * scalar(solution[column[k], c])
                out[r, c] = size * total

    return restrict, extend


@dataclass(frozen=True, eq=False)
class SolveBuffers:
    """Arrays for one batch width: right-hand sides and solutions in matrix unknowns, and squared norms (b,)."""

    right_side: wp.array
    solution: wp.array
    square_norm: wp.array


class DenseInverse:
    """Inverse of an undeformed stiffness K over motions L: L (L^T K L)^-1 L^T, computed in double precision.

    `stiffness` K (3N, 3N) [N/m]; `motions` L (3N, n) with independent columns.

    Raises
    ------
    RuntimeError
        K is not positive definite over these motions, since a part of the mesh is not fixed.
    """

    on_device = True

    def __init__(self, stiffness: sp.csc_array, motions: sp.csc_array, device: Device):
        self._device = device
        where = wp.device_to_torch(device.name)
        count = len(motions.indptr) - 1
        rows = block_inverse.to_lower_block_rows(
            sp.csc_array(motions.T @ stiffness @ motions), block_inverse.compute_block_bounds(count), where
        )
        block_inverse.invert_in_place(rows)
        scale = torch.cat([-row[:, -len(row) :].diagonal() for row in rows]).sqrt()
        self._size = -(-count // TILE) * TILE
        self._inverse = _build_matrix(rows, scale, self._size, wp.dtype_to_torch(LOW_TYPES[device.precision]))
        block_inverse.release_memory(where)
        self._scale = device.upload(scale.cpu().numpy())
        back = motions @ sp.diags_array(scale.cpu().numpy())
        self._into, self._back = (_copy_to_device(sp.csr_array(matrix), device) for matrix in (motions.T, back))
        self._tiles = list_tiles(self._size, device.name)
        self._rooms: dict[int, SolveBuffers] = {}
        torch.cuda.synchronize(where)

    def prepare(self, problem: Problem, columns: int) -> None:
        """Do nothing, since the undeformed stiffness does not depend on the state."""

    def apply(self, r: wp.array, case_mask: np.ndarray, out: wp.array) -> None:
        """Multiply r by the dense matrix, in the stream of Warp."""
        device, count = self._device, r.shape[1]
        room, some = self._get_buffers(count), ROWS_PER_THREAD if count > 1 else 1
        restrict, extend = build_kernels(device, room.right_side.dtype, some)
        room.square_norm.zero_()
        add_dots(device, r, r, room.square_norm)
        inputs = [*self._into, self._scale, room.square_norm, r]
        device.launch(restrict, (-(-self._scale.shape[0] // some), count), inputs, [room.right_side])
        if self._can_use_symmetry(count):
            room.solution.zero_()
            add_product(self._tiles, wp.from_torch(self._inverse), room.right_side.flatten(), room.solution.flatten())
        else:
            with torch.cuda.stream(wp.stream_to_torch(device.name)):
                torch.matmul(self._inverse, wp.to_torch(room.right_side), out=wp.to_torch(room.solution))
        inputs = [*self._back, room.square_norm, room.solution]
        device.launch(extend, (-(-r.shape[0] // some), count), inputs, [out])

    def _can_use_symmetry(self, count: int) -> bool:
        """Return True if only half of the matrix is read: for one load case, reading determines the time."""
        return count == 1 and self._inverse.dtype == torch.float16

    def _get_buffers(self, count: int) -> SolveBuffers:
        """Return the buffers for a batch width, from a cache of workspace widths and the latest other width."""
        if count not in self._rooms:
            self._rooms = {width: room for width, room in self._rooms.items() if is_workspace_width(width)}
            low, name = LOW_TYPES[self._device.precision], self._device.name
            if self._can_use_symmetry(count):
                low = wp.float32
            shape = (self._size, -(-count // TILE) * TILE if count > 1 else 1)
            right, solved = (wp.zeros(shape, dtype=low, device=name) for _ in range(2))
            self._rooms[count] = SolveBuffers(right, solved, wp.zeros(count, dtype=wp.float64, device=name))
        return self._rooms[count]


def _build_matrix(rows: list[torch.Tensor], scale: torch.Tensor, size: int, dtype: torch.dtype) -> torch.Tensor:
    """Return the scaled matrix (size, size), whose negative lower half is given by the block rows `rows`.

    The list `rows` is emptied to free its memory.
    """
    out = torch.zeros((size, size), dtype=dtype, device=scale.device)
    while rows:
        row = rows.pop()
        stop = row.shape[1]
        first = stop - len(row)
        row /= -scale[first:stop, None]
        row /= scale[:stop]
        out[first:stop, :stop] = row
        out[:first, first:stop] = row[:, :first].T
    return out


def _copy_to_device(matrix: sp.csr_array, device: Device) -> list[wp.array]:
    indices = [device.upload(index, wp.int32) for index in (matrix.indptr, matrix.indices)]
    return [*indices, device.upload(matrix.data)]
