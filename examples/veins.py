"""An effect of one's own: bridging veins, which tie the cortex to the skull once they are taut.

    E = sum over veins of k/2 max(|u| - slack, 0)^2,  u the motion of the vertex that a vein ends at

A vein is anchored where its vertex lies in the scan, and is so much longer than it needs to be there.
"""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from sim import Body, Cases, InputError
from sim.runtime.columns import gather_columns
from sim.runtime.device import Device


@dataclass(frozen=True)
class Veins:
    """Veins at some vertices, each of a stiffness [N/m] that acts once it is longer by its slack [m].

    Raises
    ------
    InputError
        A stiffness or a slack that is not positive.
    """

    vertices: tuple[int, ...]
    stiffness: float = 20.0
    slack: float = 1e-3

    # No annotations: no fields. It acts by itself, and on where tissue is now, not on where it was.
    cause = None
    remembers = False

    def __post_init__(self) -> None:
        for name in ("stiffness", "slack"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise InputError(f"Veins.{name} is {getattr(self, name)}: give a positive number.")

    def term(self, body: Body) -> "VeinsTerm":
        """Its part of the potential on a body."""
        count = len(body.anatomy.mesh.nodes)
        if not all(0 <= vertex < count for vertex in self.vertices):
            raise InputError(f"Veins.vertices are not all in 0 to {count - 1}: name vertices of the mesh.")
        return VeinsTerm(self, body.device)


@dataclass(frozen=True)
class Kernels:
    """Each launches over (vein, column); arrays of displacements are (3N, b)."""

    add_energy: wp.Kernel
    add_gradient: wp.Kernel
    add_curvature: wp.Kernel
    add_diagonal: wp.Kernel


@cache
def build_kernels(device: Device) -> Kernels:
    """Kernels of a device's scalar type: float32 in scenes, float64 where it was asked for."""
    scalar, vec, mat = device.scalar, device.vector, device.matrix

    @wp.func
    def motion(u: wp.array2d(dtype=scalar), node: int, c: int):
        """u of a node in a column."""
        return vec(u[3 * node, c], u[3 * node + 1, c], u[3 * node + 2, c])

    @wp.func
    def bend(u: vec, k: scalar, slack: scalar):
        """Second derivative: k (n n^T + (1 - slack / |u|) (I - n n^T)) where taut. It is never negative."""
        far = wp.length(u)
        if far <= slack:
            return mat()
        along = wp.outer(u, u) / (far * far)
        return k * (along + (scalar(1.0) - slack / far) * (wp.identity(n=3, dtype=scalar) - along))

    @wp.kernel(module="unique")
    def add_energy(
        u: wp.array2d(dtype=scalar),
        nodes: wp.array(dtype=wp.int32),
        k: scalar,
        slack: scalar,
        # outputs
        out: wp.array(dtype=wp.float64),
    ):
        """E += k/2 (|u| - slack)^2."""
        i, c = wp.tid()
        far = wp.max(wp.length(motion(u, nodes[i], c)) - slack, scalar(0.0))
        wp.atomic_add(out, c, wp.float64(k * far * far / scalar(2.0)))

    @wp.kernel(module="unique")
    def add_gradient(
        u: wp.array2d(dtype=scalar),
        nodes: wp.array(dtype=wp.int32),
        k: scalar,
        slack: scalar,
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """g += k (|u| - slack) u / |u|."""
        i, c = wp.tid()
        moved = motion(u, nodes[i], c)
        far = wp.length(moved)
        if far > slack:
            force = k * (scalar(1.0) - slack / far) * moved
            for j in range(3):
                wp.atomic_add(out, 3 * nodes[i] + j, c, force[j])

    @wp.kernel(module="unique")
    def add_curvature(
        p: wp.array2d(dtype=scalar),
        u: wp.array2d(dtype=scalar),
        nodes: wp.array(dtype=wp.int32),
        k: scalar,
        slack: scalar,
        # outputs
        out: wp.array2d(dtype=scalar),
    ):
        """f += K(u) p."""
        i, c = wp.tid()
        force = bend(motion(u, nodes[i], c), k, slack) * motion(p, nodes[i], c)
        for j in range(3):
            wp.atomic_add(out, 3 * nodes[i] + j, c, force[j])

    @wp.kernel(module="unique")
    def add_diagonal(
        u: wp.array2d(dtype=scalar),
        nodes: wp.array(dtype=wp.int32),
        k: scalar,
        slack: scalar,
        # outputs
        out: wp.array2d(dtype=mat),
    ):
        """Blocks += K(u)."""
        i, c = wp.tid()
        wp.atomic_add(out, nodes[i], c, bend(motion(u, nodes[i], c), k, slack))

    return Kernels(add_energy, add_gradient, add_curvature, add_diagonal)


class VeinsTerm:
    """A `sim.Term`: it resists, does not depend on the loads, and remembers nothing."""

    name = "veins"
    constant, passive, steep = False, True, False

    def __init__(self, veins: Veins, device: Device):
        self._device, self._kernels = device, build_kernels(device)
        self._nodes = device.upload(np.array(veins.vertices, np.int32), wp.int32)
        self._numbers = [self._nodes, device.scalar(veins.stiffness), device.scalar(veins.slack)]
        self._at: wp.array | None = None

    def begin(self, cases: Cases) -> None:
        """Nothing depends on the loads."""

    def keep(self, columns: np.ndarray) -> None:
        """Keep the linearisation of some load cases only."""
        if self._at is not None:
            self._at = gather_columns(self._device, self._at, columns)

    def energy(self, u: wp.array, out: wp.array) -> None:
        """E of each column."""
        self._launch(self._kernels.add_energy, [u], out, u.shape[1])

    def add_gradient(self, u: wp.array, out: wp.array) -> None:
        """Add the forces of taut veins."""
        self._launch(self._kernels.add_gradient, [u], out, u.shape[1])

    def linearise(self, u: wp.array, definite: wp.array) -> None:
        """Linearise at a copy of u, which the solver changes in place."""
        self._at = wp.clone(u)

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        """K(u) p."""
        self._launch(self._kernels.add_curvature, [p, self._at], out, p.shape[1])

    def add_diagonal(self, out: wp.array) -> None:
        """3 x 3 blocks of K(u)."""
        self._launch(self._kernels.add_diagonal, [self._at], out, out.shape[1])

    def rest_curvature(self) -> None:
        """At rest no vein is taut: preconditioners have nothing to know."""

    def longest_step(self, u: wp.array, du: wp.array, out: wp.array) -> None:
        """Every motion has an energy."""

    def end(self, u: wp.array) -> None:
        """Nothing has to travel to the next answer."""

    def _launch(self, kernel: wp.Kernel, inputs: list, out: wp.array, columns: int) -> None:
        self._device.launch(kernel, (len(self._nodes), columns), [*inputs, *self._numbers], [out])
