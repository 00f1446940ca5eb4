"""Two tiny terms in NumPy that ask of the solver what later effects will: a memory, and a domain to stay in."""

import numpy as np
import scipy.sparse as sp
import warp as wp

from sim.discretisation.term import Cases
from sim.runtime.columns import combine_columns, compute_dots, gather_columns
from sim.runtime.device import Device


class Spring:
    """A Term: every node on a spring of `stiffness` [N/m] to an anchor that creeps after it.

    E = k/2 |u - a|^2; over a step dt the anchor moves to a + (1 - exp(-dt / tau)) (u - a). History: a (B, N, 3) [m].
    """

    constant, passive, steep = False, False, False

    def __init__(self, device: Device, rows: int, stiffness: float, tau: float = 1.0):
        self.name = "spring"
        self._device, self._rows, self._stiffness, self._tau = device, rows, stiffness, tau

    def begin(self, cases: Cases) -> None:
        count = len(cases.loads)
        anchor = np.asarray(cases.memory.get(self.name, np.zeros((count, self._rows // 3, 3))))
        self._anchor = self._device.upload(anchor.reshape(count, -1).T)
        self._creep = 1.0 - np.exp(-(cases.loads.times - cases.start_time) / self._tau)

    def keep(self, columns: np.ndarray) -> None:
        self._anchor, self._creep = gather_columns(self._device, self._anchor, columns), self._creep[columns]

    def energy(self, u: wp.array, out: wp.array) -> None:
        away = self._away(u)
        out.assign(out.numpy() + 0.5 * self._stiffness * compute_dots(self._device, away, away))

    def add_gradient(self, u: wp.array, out: wp.array) -> None:
        self.add_curvature(self._away(u), out)

    def linearise(self, u: wp.array, definite: wp.array) -> None:
        pass

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        combine_columns(self._device, out, np.full(p.shape[1], self._stiffness), p, out)

    def add_diagonal(self, out: wp.array) -> None:
        out.assign(out.numpy() + self._stiffness * np.eye(3))

    def rest_curvature(self) -> sp.csc_array:
        return sp.csc_array(self._stiffness * sp.eye_array(self._rows))

    def longest_step(self, u: wp.array, du: wp.array, out: wp.array) -> None:
        pass

    def end(self, u: wp.array) -> np.ndarray:
        anchor = self._anchor.numpy() + self._creep * self._away(u).numpy()
        return anchor.T.reshape(len(self._creep), -1, 3)

    def _away(self, u: wp.array) -> wp.array:
        return combine_columns(self._device, u, np.full(u.shape[1], -1.0), self._anchor, wp.empty_like(u))


class Wall:
    """A Term: a barrier that keeps every node below `height` [m].

    E = -k sum (h - d)^2 ln(h / d) over nodes whose distance h to the wall is below d; +inf where h <= 0.
    Li et al. 2020, "Incremental Potential Contact", eq. 6. No rest curvature: the wall is far away at rest.
    """

    constant, passive, steep = False, False, False

    def __init__(self, device: Device, nodes: np.ndarray, height: float, reach: float, stiffness: float):
        self.name = "wall"
        self._device, self._room = device, height - nodes[:, 2:]
        self._reach, self._stiffness = reach, stiffness

    def begin(self, cases: Cases) -> None:
        pass

    def keep(self, columns: np.ndarray) -> None:
        pass

    def distance(self, u: np.ndarray) -> np.ndarray:
        """Distances (N, b) [m] to the wall of u (3N, b)."""
        return self._room - u[2::3]

    def energy(self, u: wp.array, out: wp.array) -> None:
        h, d = self.distance(u.numpy().astype(np.float64)), self._reach
        near = np.clip(h, 1e-300, d)
        barrier = np.where(h > 0.0, -self._stiffness * (near - d) ** 2 * np.log(near / d), np.inf)
        out.assign(out.numpy() + barrier.sum(axis=0))

    def add_gradient(self, u: wp.array, out: wp.array) -> None:
        h, d = self.distance(u.numpy()), self._reach
        near = np.minimum(h, d)
        with np.errstate(invalid="ignore"):
            slope = self._stiffness * (2.0 * (near - d) * np.log(near / d) + (near - d) ** 2 / near)
        self._add_normal(slope, out)

    def linearise(self, u: wp.array, definite: wp.array) -> None:
        near, d = np.minimum(self.distance(u.numpy()), self._reach), self._reach
        self._bend = -self._stiffness * (2.0 * np.log(near / d) + 4.0 * (near - d) / near - ((near - d) / near) ** 2)

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        self._add_normal(self._bend * p.numpy()[2::3], out)

    def add_diagonal(self, out: wp.array) -> None:
        blocks = out.numpy()
        blocks[:, :, 2, 2] += self._bend
        out.assign(blocks)

    def rest_curvature(self) -> None:
        return None

    def longest_step(self, u: wp.array, du: wp.array, out: wp.array) -> None:
        h, towards = self.distance(u.numpy()), du.numpy()[2::3]
        limit = np.divide(0.9 * h, towards, out=np.full_like(h, np.inf), where=towards > 0.0)
        out.assign(np.minimum(out.numpy(), limit.min(axis=0)))

    def end(self, u: wp.array) -> None:
        return None

    def _add_normal(self, force: np.ndarray, out: wp.array) -> None:
        values = out.numpy()
        values[2::3] += force
        out.assign(values)
