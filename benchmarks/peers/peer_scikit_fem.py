"""scikit-fem: one basis for all loads, one-point forms in threads, PARDISO for symmetric matrices."""

import numpy as np
from skfem import Basis, BilinearForm, ElementTetP1, ElementVector, LinearForm, MeshTet, condense
from skfem import solve as solve_linear
from skfem.helpers import ddot, det, grad, inv, mul, trace, transpose
from symmetric import solve as solve_symmetric

from benchmarks.peers.engine_process import Case, Solve, serve_loads

STEPS, HALVINGS = 30, 10


def set_up_solver(case: Case) -> Solve:
    """Build the basis, the forms on it, and Newton's method, which scikit-fem leaves to the user."""
    mesh = MeshTet(np.ascontiguousarray(case.nodes.T), np.ascontiguousarray(case.tets.T))
    basis = Basis(mesh, ElementVector(ElementTetP1()), intorder=1)
    free = np.flatnonzero(~np.repeat(case.held, 3))
    identity = np.eye(3)[:, :, None, None]

    @LinearForm
    def internal(v, w):
        return ddot(w.P, grad(v))

    @BilinearForm(nthreads=2)
    def tangent(u, v, w):
        du, dv = mul(grad(u), w.inverse), mul(grad(v), w.inverse)
        shape = case.mu * ddot(grad(u), grad(v)) + w.shear * ddot(transpose(du), dv)
        return shape + case.lam * trace(du) * trace(dv)

    def state(u: np.ndarray, load: np.ndarray) -> tuple[np.ndarray, float, dict[str, np.ndarray]]:
        """Compute the residual [N], its relative free part (inf where the law is), and the tangent's arguments."""
        F = identity + basis.interpolate(u).grad
        J = det(F)
        if not (J > 0.0).all():
            return load, np.inf, {}
        inverse, log_J = inv(F), np.log(J)
        inner = internal.assemble(basis, P=case.mu * F + (case.lam * log_J - case.mu) * transpose(inverse))
        residual = inner - load
        reaction = residual.copy()
        reaction[free] = 0.0
        scale = max(np.linalg.norm(part) for part in (inner, load, reaction))
        left = float(np.linalg.norm(residual[free]) / scale)
        return residual, left, {"inverse": inverse, "shear": case.mu - case.lam * log_J}

    def solve(force: np.ndarray) -> np.ndarray:
        load = force.ravel()
        u = np.zeros(basis.N)
        residual, left, fields = state(u, load)
        for _ in range(STEPS):
            if left <= case.tolerance:
                return u.reshape(-1, 3)
            K = tangent.assemble(basis, **fields)
            step = np.zeros(basis.N)
            step[free] = solve_linear(*condense(K, -residual, I=free, expand=False), solver=solve_symmetric)
            for halving in range(HALVINGS):
                trial = u + 0.5**halving * step
                residual, left, fields = state(trial, load)
                if np.isfinite(left):
                    break
            u = trial
        raise RuntimeError(f"Newton stopped at {left:.1e} after {STEPS} steps")

    return solve


if __name__ == "__main__":
    serve_loads(set_up_solver)
