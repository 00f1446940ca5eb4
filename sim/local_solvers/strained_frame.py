"""What live frames on a device know of strained tissue: a model in fixed arrays, which is made anew between frames.

As `strained_descent.py` has it, but with the matrix M = -(1 + D C)^-1 D at hand: a captured graph multiplies by it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from ..arguments import all_finite
from ..discretisation.problem import Problem
from ..linalg.pcg import Preconditioner
from ..runtime.columns import combined
from ..runtime.device import Device, forward_kernel
from ..runtime.views import in_order, library, like, placed, solved, view
from .strained_part import StrainedPart

# Names in an answer's `warm`.
ROWS, MATRIX = "bent rows", "bent matrix"
# A product is divided among so many threads a row.
PARTS = 16


@cache
def press_of(device: Device) -> wp.Kernel:
    """The kernel that multiplies by M, over (part of a row, row)."""
    scalar = device.scalar

    @forward_kernel(module="unique")
    def press(
        rows: wp.array(dtype=wp.int32),
        matrix: wp.array2d(dtype=wp.float32),
        motion: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """out = E M E' motion; M is symmetric, and read along its columns."""
        part, i = wp.tid()
        count = rows.shape[0]
        chunk = (count + PARTS - 1) // PARTS
        total = scalar(0.0)
        for j in range(part * chunk, wp.min((part + 1) * chunk, count)):
            total += scalar(matrix[j, i]) * motion[rows[j], 0]
        if total != scalar(0.0):
            wp.atomic_add(out, rows[i], 0, total)

    return press


@dataclass(frozen=True, eq=False)
class Bent:
    """A model on the device, to which nobody writes: rows (n,) of the 3N, matrix (n, n) float32 M [N/m].

    Zeros fill what is not needed.
    """

    rows: wp.array
    matrix: wp.array

    @property
    def learnt(self) -> dict[str, np.ndarray]:
        """As an answer's `warm` has it."""
        return {ROWS: self.rows.numpy()[None], MATRIX: self.matrix.numpy()[None]}


def bent_at(part: StrainedPart, device: Device, u: wp.array) -> Bent | None:
    """The model at u (3N, 1) [m], which the problem has begun, of a part that is prepared; None where there is none.

    A card is not waited for.
    """
    with in_order(device):
        found = part.stiffening(u, np.arange(1), full=True)
        if found is None:
            return None
        compliance, lib = part.compliance, library(device)
        places, added = found[0][0], found[1][0]
        axes = like(places, placed(device, np.arange(3)))
        rows = (3 * places[:, None] + axes).reshape(-1)
        soft, own = compliance.columns[rows[:, None], rows], wp.zeros(added.shape, dtype=wp.float32, device=device.name)
        bent, added = view(own), like(view(own), added)
        system = added @ like(bent, 0.5 * (soft + soft.T))
        diagonal = range(len(rows))
        system[diagonal, diagonal] += 1.0
        matrix = -solved(system, added)
        bent[:] = lib.where(lib.isfinite(matrix).all(), 0.5 * (matrix + matrix.T), 0.0 * added)
        of = wp.zeros(len(rows), dtype=wp.int32, device=device.name)
        nodes = like(places, placed(device, compliance.nodes))[places]
        view(of)[:] = like(view(of), (3 * nodes[:, None] + axes).reshape(-1))
        return Bent(of, own)


def bent_from(warm: Mapping[str, np.ndarray], device: Device, count: int, size: int) -> Bent | None:
    """What an answer on as many rows = 3N left warm; None if there is nothing, or it does not fit."""
    if ROWS not in warm or MATRIX not in warm:
        return None
    rows, matrix = np.asarray(warm[ROWS]), np.asarray(warm[MATRIX])
    if rows.shape != (1, size) or matrix.shape != (1, size, size) or rows.dtype.kind != "i":
        return None
    if matrix.dtype != np.float32 or not all_finite(matrix) or (rows < 0).any() or (rows >= count).any():
        return None
    return Bent(device.array(rows[0], wp.int32), wp.array(matrix[0], dtype=wp.float32, device=device.name))


class BentPreconditioner:
    """A Preconditioner of single columns: the rest's, and what the model in its arrays adds.

    Parameters
    ----------
    rest
        The inverse of the rest stiffness.
    problem
        Whose it is.
    size
        Rows n of the models.
    """

    def __init__(self, rest: Preconditioner, problem: Problem, size: int):
        self._rest, self._problem, self.on_device = rest, problem, rest.on_device
        name = problem.device.name
        self._rows = wp.zeros(size, dtype=wp.int32, device=name)
        self._matrix = wp.zeros((size, size), dtype=wp.float32, device=name)
        self._pull, self._more = (problem.device.zeros(problem.rows, 1) for _ in range(2))

    def load(self, bent: Bent | None) -> None:
        """Take another model, or none."""
        if bent is None:
            self._matrix.zero_()
        else:
            wp.copy(self._rows, bent.rows)
            wp.copy(self._matrix, bent.matrix)

    def prepare(self, problem: Problem, columns: int) -> None:
        """As the rest."""
        self._rest.prepare(problem, columns)

    def apply(self, r: wp.array, live: np.ndarray, out: wp.array) -> None:
        """The rest's twice: of a force, and of what the model adds to it."""
        device = self._problem.device
        self._rest.apply(r, live, out)
        self._pull.zero_()
        device.launch(press_of(device), (PARTS, len(self._rows)), [self._rows, self._matrix, out], [self._pull])
        self._problem.constraint.project_nodes(self._pull)
        self._rest.apply(self._pull, live, self._more)
        combined(device, out, 1.0, self._more, out)
