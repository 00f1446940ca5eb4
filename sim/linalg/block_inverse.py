"""Inversion and elimination of symmetric positive definite matrices on CUDA, in place and in blocks of the lower half.

The first unknowns of a symmetric matrix [[A, B^T], [B, C]] are exchanged with their right-hand sides. This gives
[[-A^-1, A^-1 B^T], [B A^-1, C - B A^-1 B^T]]. Goodnight 1979, "A tutorial on the SWEEP operator", Am. Stat. 33:149-158.
The exchange of all unknowns gives the inverse, in n^3 operations and 4 n^2 bytes of double precision; a library needs
memory for both factor and inverse. The implementation uses torch, as `dense_inverse` does.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
import torch

TEMPORARY_ROWS = 3  # Temporary block rows, in addition to the matrix, during an exchange.


@dataclass(frozen=True)
class BlockInversion:
    """Block size and limits for the exchange of unknowns.

    Parameters
    ----------
    block_size
        Number of unknowns per block; temporary memory is proportional to this number.
    memory_fraction
        Maximum fraction of the free memory that is used.
    max_seconds
        Maximum duration of an exchange [s].
    trial_size
        Size of the matrix product by which the speed of a device is measured.
    """

    block_size: int = 4096
    memory_fraction: float = 0.9
    max_seconds: float = 40.0
    trial_size: int = 4096


@cache
def measure_matmul_rate(device: str, size: int = BlockInversion.trial_size) -> float:
    """Return the measured multiply-adds per second in double precision, from the second of two products of `size`."""
    one, spent = torch.ones((size, size), dtype=torch.float64, device=device), 0.0
    for _ in range(2):
        begun = time.perf_counter()
        float((one @ one)[0, 0])  # waits for the result
        spent = time.perf_counter() - begun
    return size**3 / spent


def estimate_bytes(count: int, settings: BlockInversion = BlockInversion()) -> int:
    """Return the estimated memory [bytes] of an exchange: half a matrix in double precision, and temporary rows."""
    return 8 * (count * (count + settings.block_size) // 2 + TEMPORARY_ROWS * min(count, settings.block_size) * count)


def can_invert(count: int, device: str, other_bytes: int = 0, settings: BlockInversion = BlockInversion()) -> bool:
    """Return True if a GPU can exchange `count` unknowns in time, with memory for this and `other_bytes` bytes."""
    if not torch.cuda.is_available():
        return False
    free, _ = torch.cuda.mem_get_info(device)
    if estimate_bytes(count, settings) + other_bytes >= settings.memory_fraction * free:
        return False
    return count**3 / 2 < settings.max_seconds * measure_matmul_rate(device, settings.trial_size)


def to_lower_block_rows(matrix: sp.csc_array, bounds: Sequence[int], device: str) -> list[torch.Tensor]:
    """Return the block rows of a symmetric matrix (n, n) between the `bounds`, each up to its diagonal block."""
    rows, out = sp.csr_array(matrix), []
    for first, stop in pairwise(bounds):
        part = sp.coo_array(rows[first:stop])
        own = part.col < stop
        place = tuple(torch.as_tensor(index[own], dtype=torch.int64, device=device) for index in (part.row, part.col))
        block = torch.zeros((stop - first, stop), dtype=torch.float64, device=device)
        out.append(block.index_put_(place, torch.as_tensor(part.data[own].astype(np.float64), device=device)))
    return out


def invert_in_place(rows: Sequence[torch.Tensor]) -> None:
    """Replace A by -A^-1 in the block rows from `to_lower_block_rows`.

    Raises
    ------
    RuntimeError
        A is not positive definite.
    """
    for k in range(len(rows)):
        stop = rows[k].shape[1]
        own = slice(stop - len(rows[k]), stop)
        inverse = _invert_block(rows[k][:, own])
        across = torch.cat([rows[k], *(row[:, own].T for row in rows[k + 1 :])], dim=1)
        across[:, own] = 0.0
        solved = inverse @ across
        for row in rows:
            if row is not rows[k]:
                mine = slice(row.shape[1] - len(row), row.shape[1])
                row.addmm_(across[:, mine].T, solved[:, : mine.stop], alpha=-1.0)
                if mine.start >= stop:
                    row[:, own] = solved[:, mine].T
        rows[k][:] = solved[:, :stop]
        rows[k][:, own] = -inverse


def compute_block_bounds(count: int, block_size: int = BlockInversion.block_size) -> list[int]:
    """Return the bounds of blocks of `count` unknowns."""
    return [*range(0, count, block_size), count]


def eliminate_unknowns(
    matrix: sp.csc_array, border: sp.csc_array, device: str, block_size: int = BlockInversion.block_size
) -> tuple[np.ndarray, np.ndarray]:
    """Return X = A^-1 B (n, m) in single precision, and B^T X (m, m), for sparse A (n, n) and B (n, m).

    Raises
    ------
    RuntimeError
        A is not positive definite.
    """
    cuts = compute_block_bounds(len(matrix.indptr) - 1, block_size)
    stop = cuts[-1] + len(border.indptr) - 1
    whole = sp.csc_array(sp.block_array([[matrix, border], [border.T, None]]))
    *rows, last = to_lower_block_rows(whole, [*cuts, stop], device)
    for k in range(len(rows)):
        _eliminate_block(rows[k], [*rows[k + 1 :], last])
    while rows:  # back substitution
        row = rows.pop()
        own = slice(row.shape[1] - len(row), row.shape[1])
        for first, stop in pairwise(cuts[: len(rows) + 1]):
            last[:, first:stop].addmm_(last[:, own], row[:, first:stop], alpha=-1.0)
    return last[:, : cuts[-1]].T.to(torch.float32).cpu().numpy(), -last[:, cuts[-1] :].cpu().numpy()


def _eliminate_block(row: torch.Tensor, lower_rows: Sequence[torch.Tensor]) -> None:
    """Eliminate the unknowns of a block from the rows below; the block's columns then store the solution."""
    stop = row.shape[1]
    own = slice(stop - len(row), stop)
    across = torch.cat([later[:, own].T for later in lower_rows], dim=1)
    solved = _invert_block(row[:, own]) @ across
    for later in lower_rows:
        mine = slice(later.shape[1] - len(later) - stop, later.shape[1] - stop)
        later[:, stop:].addmm_(across[:, mine].T, solved[:, : mine.stop], alpha=-1.0)
        later[:, own] = solved[:, mine].T


def _invert_block(block: torch.Tensor) -> torch.Tensor:
    return torch.cholesky_inverse(torch.linalg.cholesky(block))


def release_memory(device: str) -> None:
    """Release the GPU memory that torch has cached, since batches of loads need this memory."""
    if device != "cpu":
        torch.cuda.empty_cache()
