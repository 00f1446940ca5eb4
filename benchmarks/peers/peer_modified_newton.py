"""Modified Newton: PARDISO factorises the undeformed stiffness once for all loads; all else is NumPy.

If the expected number of steps with this factor costs more than a new one, the present stiffness is factorised too.
"""

import numpy as np
import scipy.sparse as sp
from symmetric import Factor

from benchmarks.peers.engine_process import Case, Solve, serve_loads

STEPS, TRIALS = 500, 8
SLOPE_LEFT = 0.5
# Cost of a new factor with its stiffness, in steps with a stored factor (5,312 nodes, two cores).
WORTH = 20


class NeoHookeanBody:
    """Forces and stiffness of linear tetrahedra at the free components of the displacement."""

    def __init__(self, case: Case):
        self.case = case
        edges = np.swapaxes(case.nodes[case.tets[:, 1:]] - case.nodes[case.tets[:, :1]], 1, 2)
        inner = np.linalg.inv(edges)  # (T, 3, 3): shape gradients of nodes 1 to 3, as rows
        shape = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)
        self.volume = np.linalg.det(edges) / 6.0
        count = len(case.tets)
        # Row (t, i, j) of `gradient` gives du_i/dX_j in tetrahedron t.
        row = np.arange(9 * count).reshape(count, 3, 3, 1)
        column = 3 * case.tets[:, None, None, :] + np.arange(3)[None, :, None, None]
        row, column = np.broadcast_arrays(row, column)
        values = np.broadcast_to(np.swapaxes(shape, 1, 2)[:, None], row.shape)
        size = 3 * len(case.nodes)
        self.gradient = sp.csr_array((values.ravel(), (row.ravel(), column.ravel())), (9 * count, size))
        self.spread = sp.csr_array(self.gradient.T)
        self.free = np.flatnonzero(~np.repeat(case.held, 3))
        self.narrow = sp.csr_array(self.gradient[:, self.free])

    def compute_deformation(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute F (T, 3, 3), F^-T and ln J, which is not finite where the law is undefined."""
        F = (self.gradient @ u).reshape(-1, 3, 3) + np.eye(3)
        cofactor = np.stack([np.cross(F[:, (i + 1) % 3], F[:, (i + 2) % 3]) for i in range(3)], axis=1)
        J = np.einsum("tj,tj->t", F[:, 0], cofactor[:, 0])
        with np.errstate(invalid="ignore", divide="ignore"):
            return F, cofactor / J[:, None, None], np.log(J)

    def compute_forces(self, u: np.ndarray) -> np.ndarray:
        """Compute internal forces [N], not finite where the law is undefined."""
        F, inverse, log_J = self.compute_deformation(u)
        stress = self.case.mu * F + (self.case.lam * log_J - self.case.mu)[:, None, None] * inverse
        return self.spread @ (self.volume[:, None, None] * stress).ravel()

    def assemble_stiffness(self, u: np.ndarray) -> sp.csr_array:
        """Assemble the tangent stiffness [N/m] of the free components."""
        _, inverse, log_J = self.compute_deformation(u)
        shear = self.case.mu - self.case.lam * log_J
        moduli = np.einsum("tij,tkl->tijkl", self.case.lam * inverse, inverse)
        moduli += np.einsum("t,til,tkj->tijkl", shear, inverse, inverse)
        moduli += self.case.mu * np.einsum("ik,jl->ijkl", np.eye(3), np.eye(3))
        moduli = (self.volume[:, None, None, None, None] * moduli).reshape(-1, 9, 9)
        count = len(moduli)
        blocks = sp.bsr_array((moduli, np.arange(count), np.arange(count + 1)))
        return sp.csr_array(self.narrow.T @ (blocks @ self.narrow))


def _steps_left(kept: list[float], tolerance: float) -> float:
    """Estimate the number of steps to the tolerance at the mean rate of the last two; 0 before two steps."""
    if len(kept) < 3:
        return 0.0
    rate = np.sqrt(kept[-1] / kept[-3])
    return float(np.log(tolerance / kept[-1]) / np.log(rate)) if rate < 1.0 else np.inf


def set_up_solver(case: Case) -> Solve:
    """Factorise the undeformed stiffness for all loads, and allocate a factor of a deformed body."""
    body, at_rest, later = NeoHookeanBody(case), Factor(), Factor()
    at_rest.factorise(body.assemble_stiffness(np.zeros(3 * len(case.nodes))))
    free = body.free

    def solve(force: np.ndarray) -> np.ndarray:
        load = force.ravel()

        def state(u: np.ndarray) -> tuple[np.ndarray, float]:
            """Compute the free residual [N], and the relative one: inf where the law is undefined."""
            inner = body.compute_forces(u)
            residual = inner - load
            reaction = residual.copy()
            reaction[free] = 0.0
            scale = max(np.linalg.norm(part) for part in (inner, load, reaction))
            left = float(np.linalg.norm(residual[free]) / scale)
            return residual[free], left if np.isfinite(left) else np.inf

        u, factor = np.zeros(len(load)), at_rest
        residual, left = state(u)
        kept = [left]
        for _ in range(STEPS):
            if not np.isfinite(left):
                break
            if left <= case.tolerance:
                return u.reshape(-1, 3)
            if _steps_left(kept, case.tolerance) > WORTH:
                later.factorise(body.assemble_stiffness(u))
                factor, kept = later, [left]
            step = factor.solve(-residual)
            start, share, trial = residual @ step, 1.0, u.copy()
            for _ in range(TRIALS):
                trial[free] = u[free] + share * step
                residual, left = state(trial)
                along = residual @ step
                if abs(along) <= SLOPE_LEFT * abs(start):
                    break
                # Zero of the force along the step if that were linear; half of the step where the law is undefined.
                share *= float(np.clip(start / (start - along), 0.2, 3.0)) if np.isfinite(left) else 0.5
            u = trial
            kept.append(left)
        raise RuntimeError(f"modified Newton stopped at {left:.1e} after {STEPS} steps")

    return solve


if __name__ == "__main__":
    serve_loads(set_up_solver)
