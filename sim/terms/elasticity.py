"""Elastic energy: integral of psi(H) over the undeformed volume, for any law and element type."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..discretisation.element import Elements, assemble_hooke_stiffness, assemble_tangent_stiffness
from ..discretisation.term import Cases
from ..runtime.columns import Workspaces
from ..runtime.device import Device
from ..runtime.threads import choose_threads, run_concurrently
from .element_kernels import build_broadcast_kernel, build_kernels
from .laws.law import Law
from .state_source import StateSource

# Step of finite differences in the displacement gradient.
GRADIENT_STEP = 1e-3


@dataclass(frozen=True, eq=False)
class _Part:
    """Block of elements: first index and number; sizes, node numbers, shape gradients, weights, and coefficients."""

    first: int
    count: int
    shape: list[wp.array]
    weight: wp.array
    coefficients: wp.array


class ElasticTerm:
    """Energy term of hyperelastic elements.

    Parameters
    ----------
    name
        Unique name in the problem.
    law
        Material law, which defines the energy density.
    elements
        Set of T elements.
    coefficients
        Coefficients (T, k) of the law.
    lame
        Lamé parameters mu and lambda (T, 2) at small strain [Pa].
    device
        Device of the arrays.
    sources
        Sources of additional coefficients per quadrature point and load case, from the innermost law to the outermost
        law. At most one source has history variables.
    """

    constant, steep = False, False

    def __init__(
        self,
        name: str,
        law: Law,
        elements: Elements,
        coefficients: np.ndarray,
        lame: np.ndarray,
        device: Device,
        sources: Sequence[StateSource] = (),
    ):
        self.name = name
        self.passive = not sources
        self._device = device
        self._sources = sources
        self._cases: Cases | None = None
        count = own = coefficients.shape[1]
        size = elements.table.shape[1] if elements.sizes is None else 0
        sizes = np.zeros(0, np.int32) if elements.sizes is None else elements.sizes
        self._rest, self._tissue = (elements, *lame.T), (law, coefficients)
        for source in sources:
            law, count = source.build_law(law, count), count + source.count
        self._kernels = build_kernels(law, device, size, count)
        self._of = law, device, size, count
        shape = self._shape = [
            device.upload(sizes, wp.int32),
            device.upload(elements.table, wp.int32),
            device.upload(elements.gradient, device.vector),
        ]
        weight = self._weight = device.upload(elements.weight)
        constants = device.upload(coefficients, wp.types.vector(length=own, dtype=device.scalar))
        self._constants = device.upload(coefficients) if sources else constants
        points = elements.weight.shape
        self._numbers = Workspaces(lambda columns: device.allocate(*points, count, columns), device)
        self._strains = Workspaces(lambda columns: wp.empty((*points, columns), device.matrix, device.name), device)
        every = len(elements.table)
        ends = np.linspace(0, every, (1 if device.on_cuda else choose_threads(every)) + 1).astype(int).tolist()
        self._parts = [
            _Part(
                first,
                stop - first,
                [_slice_rows(array, first, stop) for array in shape],
                _slice_rows(weight, first, stop),
                _slice_rows(constants, first, stop),
            )
            for first, stop in pairwise(ends)
        ]
        self._at: wp.array | None = None
        self._definite: wp.array | None = None

    @property
    def keys(self) -> np.ndarray:
        """Unique key (T q, k) of each quadrature point: key of the element, and index of the point in the element."""
        elements = self._rest[0]
        count, points = elements.weight.shape
        return np.column_stack([np.repeat(elements.keys, points, axis=0), np.tile(np.arange(points), count)])

    @property
    def width(self) -> int:
        """Number of history variables per quadrature point."""
        return max((source.width for source in self._sources), default=0)

    @property
    def prevents_inversion(self) -> bool:
        """True if the law requires J > 0."""
        return self._kernels.bound_step is not None

    def begin(self, cases: Cases) -> None:
        """Compute the varying coefficients of the load cases, if there are sources."""
        if self._sources:
            self._cases, numbers = cases, self._numbers.get_array(len(cases.loads))
            points, own = numbers.shape[:2], self._tissue[1].shape[1]
            dim = (*points, own, len(cases.loads))
            self._device.launch(build_broadcast_kernel(self._device), dim, [self._constants], [numbers])
            for source in self._sources:
                source.fill(cases, own, numbers)
                own += source.count

    def keep(self, columns: np.ndarray) -> None:
        """Keep only the varying coefficients of the load cases `columns`."""
        if self._cases is not None:
            self.begin(self._cases.select(columns))

    def energy(self, u: wp.array, out: wp.array) -> None:
        """Add the elastic energy: E += sum of w psi(H)."""
        self._launch(self._kernels.add_energy, [u], out, u.shape[1])

    def add_gradient(self, u: wp.array, out: wp.array) -> None:
        """Add the internal forces: f += sum of w P grad N."""
        self._launch(self._kernels.add_gradient, [u], out, u.shape[1])

    def linearise(self, u: wp.array, definite: wp.array) -> None:
        """Set the linearisation point u; `definite` load cases use Hooke's stiffness, which is positive definite."""
        self._at, self._definite = wp.clone(u), definite

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        """Add the tangent stiffness times p: f += K(u) p."""
        self._launch(self._kernels.add_curvature, [p, self._at, self._definite], out, p.shape[1])

    def add_diagonal(self, out: wp.array) -> None:
        """Add the diagonal 3 x 3 blocks of K(u)."""
        self._launch(self._kernels.add_diagonal, [self._at, self._definite], out, out.shape[1])

    def rest_curvature(self) -> sp.csc_array:
        """Return the linear elastic stiffness (3N, 3N), the tangent of every law in the undeformed configuration."""
        return assemble_hooke_stiffness(*self._rest)

    def assemble_stiffness(self) -> sp.csc_array:
        """Return the tangent stiffness K(u) (3N, 3N) [N/m] of one load case at the last linearisation."""
        assert self._at is not None
        tangent = wp.zeros((*self._rest[0].weight.shape, 9), dtype=self._device.matrix, device=self._device.name)
        outputs = [tangent[part.first : part.first + part.count] for part in self._parts]
        numbers = self._numbers.get_array(1) if self._sources else None
        self._launch_on_blocks(
            self._strain_kernels.compute_tangents,
            lambda part: [self._at, *part.shape, _get_coefficients(part, numbers)], outputs, 1,
        )  # fmt: skip
        found = tangent.numpy().astype(np.float64).reshape(*tangent.shape, 9)
        return assemble_tangent_stiffness(self._rest[0], 0.5 * (found + found.swapaxes(2, 3)))

    def compute_coefficient_work(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the derivatives of the work as `StrainTerm.compute_coefficient_work`."""
        from .coefficient_kernels import build_kernel

        law, device, size, count = self._of
        device, elements, own = replace(device, precision="float64"), self._rest[0], self._tissue[1].shape[1]
        numbers = device.upload(self._tissue[1], wp.types.vector(length=own, dtype=wp.float64))
        if self._sources:
            numbers = device.upload(self._numbers.get_array(u.shape[1]).numpy())
        out = device.allocate(len(elements.table), own, u.shape[1])
        shape = [self._shape[0], self._shape[1], device.upload(elements.gradient, device.vector)]
        inputs = [device.upload(u), device.upload(v), *shape, device.upload(elements.weight), numbers]
        device.launch(build_kernel(law, device, size, count, own), (len(out), u.shape[1]), inputs, [out])
        return out.numpy()

    def compute_second_order(self) -> tuple[Elements, np.ndarray, np.ndarray]:
        """Return the data of `StrainTerm.compute_second_order`, by fourth-order central differences of the stress."""
        elements, (law, coefficients) = self._rest[0], self._tissue
        tissues, kind = np.unique(coefficients, axis=0, return_inverse=True)
        one = _build_unit_element(elements)
        unit = np.eye(9)
        both = (unit[:, None] + unit).reshape(-1, 9)
        size = GRADIENT_STEP * np.concatenate([both, -both, 2.0 * both, -2.0 * both, np.zeros((1, 9))])
        # u of node k + 1 is column k of the displacement gradient
        u = np.zeros((3 * one.node_count, len(size)))
        u[3:12] = size.reshape(-1, 3, 3).transpose(2, 1, 0).reshape(9, -1)
        tensors = []
        for each in tissues:
            term = ElasticTerm(self.name, law, one, each[None], np.zeros((1, 2)), self._device)
            out = self._device.allocate(*u.shape)
            term.add_gradient(self._device.upload(u), out)
            stress = out.numpy()[3:12].reshape(3, 3, -1).transpose(2, 1, 0).reshape(-1, 9)
            up, down, above, below = np.split(stress[:-1], 4)
            whole = (16.0 * (up + down) - (above + below) - 30.0 * stress[-1]) / (24.0 * GRADIENT_STEP**2)
            whole = whole.reshape(9, 9, 9)  # P2(a + b, a + b), indexed by a and b
            own = 0.25 * whole[np.arange(9), np.arange(9)]
            tensors.append(0.5 * (whole - own[:, None] - own).transpose(2, 0, 1))
        return elements, np.array(tensors), kind.ravel()

    def find_elements_on(self, nodes: np.ndarray) -> np.ndarray:
        """Return the elements (k,) all of whose nodes are marked in `nodes` (N,) bool."""
        elements = self._rest[0]
        places = np.arange(elements.table.shape[1])
        used = places < (len(places) if elements.sizes is None else elements.sizes[:, None])
        return np.flatnonzero((nodes[elements.table] | ~used).all(axis=1))

    @cached_property
    def _strain_kernels(self) -> Any:
        from .strain_kernels import build_kernels

        return build_kernels(*self._of)

    def update_max_strain(self, elements: wp.array, u: wp.array, columns: wp.array, out: wp.array) -> None:
        """Raise `out` to the strain of the elements, as `StrainTerm.update_max_strain`."""
        inputs = [u, columns, *self._shape]
        self._launch_on(self._strain_kernels.update_max_strain, elements, inputs, out, np.maximum)

    def add_stiffening(
        self, elements: wp.array, u: wp.array, columns: wp.array, min_strain: wp.array, index: wp.array, out: wp.array
    ) -> None:
        """Add the stiffness increments of the elements to `out`, as `StrainTerm.add_stiffening`."""
        coefficients = self._numbers.get_array(u.shape[1]) if self._sources else self._constants
        inputs = [u, columns, min_strain, index, *self._shape, self._weight, coefficients]
        self._launch_on(self._strain_kernels.add_stiffening, elements, inputs, out, np.add)

    def _launch_on(self, kernel: wp.Kernel, elements: wp.array, inputs: list, out: wp.array, ufunc: np.ufunc) -> None:
        """Launch a kernel on `elements` (k,) in parallel blocks with separate outputs, and join the outputs."""
        if not len(elements):
            return
        ends = np.linspace(0, len(elements), len(self._parts) + 1).astype(int).tolist()
        parts = [elements[first:stop] for first, stop in pairwise(ends) if first < stop]
        outputs = [out, *(wp.zeros_like(out) for _ in parts[1:])]
        columns = len(inputs[1])
        run_concurrently(
            [
                partial(self._device.launch, kernel, (len(part), columns), [part, *inputs], [own])
                for part, own in zip(parts, outputs, strict=True)
            ]
        )
        for other in outputs[1:]:
            ufunc(out.numpy(), other.numpy(), out=out.numpy())

    def longest_step(self, u: wp.array, du: wp.array, out: wp.array) -> None:
        """Reduce `out` to the fraction of the step up to which J > 0, if the law requires this."""
        kernel = self._kernels.bound_step
        if kernel is not None:
            bounds = [out, *(wp.clone(out) for _ in self._parts[1:])]
            self._launch_on_blocks(kernel, lambda part: [u, du, *part.shape], bounds, u.shape[1])
            for bound in bounds[1:]:
                np.minimum(out.numpy(), bound.numpy(), out=out.numpy())

    def end(self, u: wp.array) -> np.ndarray | None:
        """Return the new history variables of the source that has any; None without such a source."""
        if self._cases is None or not self.width:
            return None
        strains = self._strains.get_array(u.shape[1])
        outputs = [strains[part.first : part.first + part.count] for part in self._parts]
        self._launch_on_blocks(self._kernels.compute_gradients, lambda part: [u, *part.shape], outputs, u.shape[1])
        kept = [source.end(self._cases, strains) for source in reversed(self._sources)]
        return next((memory for memory in kept if memory is not None), None)

    def _launch(self, kernel: wp.Kernel, inputs: list, out: wp.array, columns: int) -> None:
        """Launch a kernel on all blocks and add the results to `out`."""
        sums = [out, *(wp.zeros_like(out) for _ in self._parts[1:])]
        numbers = self._numbers.get_array(columns) if self._sources else None

        def collect_inputs(part: _Part) -> list:
            return [*inputs, *part.shape, part.weight, _get_coefficients(part, numbers)]

        self._launch_on_blocks(kernel, collect_inputs, sums, columns)
        for total in sums[1:]:
            np.add(out.numpy(), total.numpy(), out=out.numpy())

    def _launch_on_blocks(
        self, kernel: wp.Kernel, inputs: Callable[[_Part], list], outputs: Sequence[wp.array], columns: int
    ) -> None:
        """Launch a kernel on all blocks in parallel, each with a separate output."""
        run_concurrently(
            [
                partial(self._device.launch, kernel, (part.count, columns), inputs(part), [out])
                for part, out in zip(self._parts, outputs, strict=True)
            ]
        )


def _build_unit_element(elements: Elements) -> Elements:
    """Return one element of unit volume with unit edges at node 0, and the node and point counts of `elements`."""
    points, most = elements.gradient.shape[1:3]
    slope = np.zeros((1, points, most, 3))
    slope[:, :, :4] = np.vstack([-np.ones(3), np.eye(3)])
    table = np.minimum(np.arange(most, dtype=np.int32), 3)[None]
    size = None if elements.sizes is None else np.full(1, 4, np.int32)
    weight, mark = np.full((1, points), 1.0 / points), np.zeros((1, 1), int)
    return Elements(table, slope, weight, 4, np.zeros(1, int), mark, size)


def _get_coefficients(part: _Part, point_coefficients: wp.array | None) -> wp.array:
    """Return the coefficients of a block: its own, or its rows of `point_coefficients` (T, q, k, b) if these vary."""
    return part.coefficients if point_coefficients is None else point_coefficients[part.first : part.first + part.count]


def _slice_rows(array: wp.array, first: int, stop: int) -> wp.array:
    """Return a view of the rows from `first` to `stop`; an empty array is returned unchanged."""
    return array[first:stop] if len(array) else array
