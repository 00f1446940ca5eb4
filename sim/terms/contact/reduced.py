"""Tool contact barrier restricted to the nodes that tools can touch, in double precision."""

from functools import lru_cache
from typing import Any, Protocol

import numpy as np
import warp as wp

from ...discretisation.term import BlockFunctions, Term
from ...runtime.device import Device
from ...runtime.views import to_view
from .tool_blocks import ContactStruct, NearPairs, build_functions


class DenseTerm(Term, Protocol):
    """Interface of terms on few nodes, whose tangent stiffness is a small dense matrix."""

    def build_structs(self, columns: np.ndarray) -> tuple[ContactStruct, NearPairs]:
        """Return surface and tools of the load cases `columns` (k,), and the workspace for near pairs."""
        ...

    def add_matrix(self, u: wp.array, definite: wp.array, index: wp.array, out: wp.array) -> None:
        """Add the stiffness K at u (3N, b) to out (b, 3m, 3m), float64, between nodes with `index` (N, b) >= 0."""
        ...


class ReducedToolBarrier:
    """Tool contact barrier on the touchable nodes, a `ReducedBarrier`.

    Parameters
    ----------
    term
        Barrier term on only these n nodes, in double precision.
    count, nodes
        Number of nodes n, and nodes per surface triangle.
    device
        Device of the arrays.
    """

    def __init__(self, term: DenseTerm, count: int, nodes: int, device: Device):
        self._term, self._count, self._nodes, self._device = term, count, nodes, device
        # Allocating an array takes as long as a launch.
        self._arrays = lru_cache(2)(self._allocate_buffers)

    @property
    def functions(self) -> BlockFunctions:
        """Warp functions of the barrier; see `ReducedBarrier.functions`."""
        return build_functions(self._device, self._nodes)

    def build_structs(self, columns: np.ndarray) -> tuple[ContactStruct, NearPairs]:
        """Return the structs; see `ReducedBarrier.build_structs`."""
        return self._term.build_structs(columns)

    def compute_gradient(self, w: Any) -> Any:
        """Return the gradient; see `ReducedBarrier.compute_gradient`."""
        at, force = self._arrays(w.shape[1])[:2]
        to_view(at)[:] = w
        force.zero_()
        self._term.add_gradient(at, force)
        return to_view(force) + 0.0  # a copy

    def compute_stiffness(self, w: Any, index: Any, size: int, definite: np.ndarray) -> Any:
        """Return the tangent stiffness; see `ReducedBarrier.compute_stiffness`."""
        at, _, numbers = self._arrays(w.shape[1])
        to_view(at)[:], to_view(numbers)[:] = w, index
        out = wp.zeros((w.shape[1], 3 * size, 3 * size), dtype=wp.float64, device=self._device.name)
        self._term.add_matrix(at, self._device.upload(definite.astype(np.int32), wp.int32), numbers, out)
        return to_view(out)

    def _allocate_buffers(self, columns: int) -> tuple[wp.array, wp.array, wp.array]:
        """Return arrays for displacements and forces (3n, b), and node indices (n, b)."""
        at, force = (self._device.allocate(3 * self._count, columns) for _ in range(2))
        return at, force, wp.zeros((self._count, columns), dtype=wp.int32, device=self._device.name)
