"""Inertia with mass-proportional damping: one backward Euler step as the minimum of an incremental potential."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..discretisation.element import build_quadratic_elements
from ..discretisation.space import Discretisation
from ..discretisation.term import Cases
from ..runtime.columns import CHUNK, Workspaces
from ..runtime.device import Device, forward_kernel

# Mass fractions of a quadratic tetrahedron's nodes: diagonal of the consistent mass matrix, scaled to the total mass.
# Row sums would be negative at corners.
CORNER_SHARE = 1.0 / 36.0  # each corner
MIDPOINT_SHARE = 4.0 / 27.0  # each midpoint


@dataclass(frozen=True)
class InertiaKernels:
    """Kernels for lumped masses, for one scalar type."""

    add_energy: wp.Kernel
    add_force: wp.Kernel
    add_blocks: wp.Kernel


@cache
def build_kernels(device: Device) -> InertiaKernels:
    """Return the kernels for the scalar type of a device."""
    scalar, mat = device.scalar, device.matrix
    chunk = CHUNK

    @forward_kernel(module="unique")
    def add_energy(
        mass: wp.array(dtype=scalar),
        weight: wp.array(dtype=scalar),
        target: wp.array2d(dtype=scalar),
        u: wp.array2d(dtype=scalar),
        # outputs
        out: wp.array(dtype=wp.float64),
    ):
        """Add the energy in double precision: E_c += w_c / 2 sum over a chunk of nodes of m_i |u_i - a_i|^2."""
        block, c = wp.tid()
        total = wp.float64(0.0)
        for i in range(block * chunk, wp.min((block + 1) * chunk, mass.shape[0])):
            for k in range(3):
                away = wp.float64(u[3 * i + k, c]) - wp.float64(target[3 * i + k, c])
                total += wp.float64(mass[i]) * away * away
        wp.atomic_add(out, c, wp.float64(0.5) * wp.float64(weight[c]) * total)

    @forward_kernel(module="unique")
    def add_force(
        mass: wp.array(dtype=scalar),
        weight: wp.array(dtype=scalar),
        x: wp.array2d(dtype=scalar),
        target: wp.array2d(dtype=scalar),
        factor: scalar,
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """Add inertial forces f_i += m_i w_c (x_i - aimed a_i); `factor` is 0 or 1."""
        i, c = wp.tid()
        for k in range(3):
            out[3 * i + k, c] += mass[i] * weight[c] * (x[3 * i + k, c] - factor * target[3 * i + k, c])

    @forward_kernel(module="unique")
    def add_blocks(
        mass: wp.array(dtype=scalar),
        weight: wp.array(dtype=scalar),
        # outputs
        out: wp.array2d(dtype=mat),
    ):
        """Add the diagonal blocks K_ii += m_i w_c I."""
        i, c = wp.tid()
        out[i, c] += mass[i] * weight[c] * wp.identity(n=3, dtype=scalar)

    return InertiaKernels(add_energy, add_force, add_blocks)


def compute_lumped_mass(density: float, space: Discretisation) -> np.ndarray:
    """Return the positive mass (N,) [kg] of each node; the sum of all masses is density x volume.

    A node of a linear tetrahedron has a quarter of its mass. Quadratic: Hinton, Rock, Zienkiewicz 1976, "A note on mass
    lumping and related processes in the finite element method", Earthq. Eng. Struct. Dyn. 4:245-249.
    """
    every = np.ones(len(space.table), bool)
    quadratic = space.table.shape[1] == 10
    share = np.repeat([CORNER_SHARE, MIDPOINT_SHARE], [4, 6]) if quadratic else np.full(4, 0.25)
    volume = space.mesh.volumes
    if quadratic:
        volume = build_quadratic_elements(space.nodes, space.table, every).weight.sum(axis=1)
    return density * np.bincount(space.table.ravel(), np.outer(volume, share).ravel(), space.count)


class InertiaTerm:
    """Inertia term: E = w/2 |u - a|^2_M, lumped mass M, w = (1/dt + damping) / dt, a = u_n + dt v_n / (1 + damping dt).

    The gradient is M ((v - v_n) / dt + damping v) with v = (u - u_n) / dt: backward Euler (Martin, Thomaszewski,
    Grinspun, Gross 2011, "Example-Based Elastic Materials", ACM Trans. Graph. 30(4), section 4). The history variables
    are velocities (B, N, 3) [m/s]. In load cases without elapsed time, w = 0 and velocities do not change.

    Parameters
    ----------
    mass
        Nodal masses (N,) [kg].
    damping
        Mass-proportional damping [1/s].
    keys
        Unique key (N, k) of each node, also after a resection.
    device
        Device of the arrays.
    """

    name = "inertia"
    constant, passive, steep = False, False, False
    width = 3

    def __init__(self, mass: np.ndarray, damping: float, keys: np.ndarray, device: Device):
        self._device, self._kernels = device, build_kernels(device)
        self._damping, self._masses, self.keys = damping, mass, keys
        self._mass = device.upload(mass)
        self._weight = Workspaces(lambda columns: device.allocate(columns), device)
        self._aim = Workspaces(lambda columns: device.allocate(3 * len(mass), columns), device)
        self._cases: Cases | None = None

    def begin(self, cases: Cases) -> None:
        """Compute the weight w and the predicted displacement a of every load case.

        Raises
        ------
        InputError
            The time of a load is before its start, or history variables belong to another mesh.
        """
        steps, count = cases.steps, len(cases.loads)
        self._cases = cases
        drift = steps / (1.0 + self._damping * steps)
        aim = self._get_start(cases) + drift[:, None, None] * self._get_velocities(cases)
        passes = np.where(steps > 0.0, steps, np.inf)
        self._weight.get_array(count).assign(1.0 / passes**2 + self._damping / passes)
        self._aim.get_array(count).assign(np.ascontiguousarray(aim.reshape(count, 3 * len(self._masses)).T))

    def keep(self, columns: np.ndarray) -> None:
        """Keep only the weights and predictions of the load cases `columns`."""
        assert self._cases is not None
        self.begin(self._cases.select(columns))

    def energy(self, u: wp.array, out: wp.array) -> None:
        """Add the energy: E += w/2 |u - a|^2_M."""
        inputs = [self._mass, self._weight.get_array(u.shape[1]), self._aim.get_array(u.shape[1]), u]
        self._device.launch(self._kernels.add_energy, (-(-len(self._mass) // CHUNK), u.shape[1]), inputs, [out])

    def add_gradient(self, u: wp.array, out: wp.array) -> None:
        """Add the gradient: f += w M (u - a)."""
        self._add_force(u, self._aim.get_array(u.shape[1]), 1.0, out)

    def linearise(self, u: wp.array, definite: wp.array) -> None:
        """Do nothing, since the tangent stiffness is constant."""

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        """Add the tangent stiffness times p: f += w M p."""
        self._add_force(p, p, 0.0, out)

    def add_diagonal(self, out: wp.array) -> None:
        """Add the diagonal blocks of w M."""
        self._device.launch(
            self._kernels.add_blocks, out.shape, [self._mass, self._weight.get_array(out.shape[1])], [out]
        )

    def rest_curvature(self) -> None:
        """Return None, the limit of an infinite time step; see `compute_step_stiffness` for finite steps."""

    def compute_step_stiffness(self, time_step: float) -> sp.csc_array:
        """Return the tangent stiffness w M (3N, 3N) [N/m] for a time step [s]."""
        weight = (1.0 + self._damping * time_step) / time_step**2
        return sp.csc_array(sp.diags_array(np.repeat(weight * self._masses, 3)))

    def longest_step(self, u: wp.array, du: wp.array, out: wp.array) -> None:
        """Do nothing, since inertia does not limit the step."""

    def end(self, u: wp.array) -> np.ndarray:
        """Return the velocities (B, N, 3) [m/s] at the end of the time step."""
        assert self._cases is not None
        now = u.numpy().astype(np.float64).T.reshape(u.shape[1], len(self._masses), 3)
        steps = self._cases.steps[:, None, None]
        passes = np.where(steps > 0.0, steps, np.inf)
        return np.where(steps > 0.0, (now - self._get_start(self._cases)) / passes, self._get_velocities(self._cases))

    def _get_start(self, cases: Cases) -> np.ndarray:
        """Return the displacement (B, N, 3) [m] at the start of the time step."""
        still = np.zeros((len(cases.loads), len(self._masses), 3))
        return still if cases.displacement is None else cases.displacement

    def _get_velocities(self, cases: Cases) -> np.ndarray:
        """Return the velocities (B, N, 3) [m/s] at the start of the time step."""
        return cases.get_past(self.name, (len(self._masses), 3))

    def _add_force(self, x: wp.array, target: wp.array, factor: float, out: wp.array) -> None:
        inputs = [self._mass, self._weight.get_array(x.shape[1]), x, target, factor]
        self._device.launch(self._kernels.add_force, (len(self._mass), x.shape[1]), inputs, [out])
