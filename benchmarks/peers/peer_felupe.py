"""FElupe (GPL, imported in this process only): Newton, threaded assembly, PARDISO for symmetric matrices."""

import felupe
import numpy as np
from symmetric import solve as solve_symmetric

from benchmarks.peers.engine_process import Case, Solve, serve_loads


def set_up_solver(case: Case) -> Solve:
    """Build a solid body with a point load on every node, for all loads."""
    mesh = felupe.Mesh(case.nodes, case.tets, "tetra")
    field = felupe.FieldContainer([felupe.Field(felupe.RegionTetra(mesh), dim=3)])
    body = felupe.SolidBody(felupe.NeoHookeCompressible(case.mu, case.lam, parallel=True), field)
    load = felupe.PointLoad(field, np.arange(len(case.nodes)))
    held = np.repeat(case.held, 3)
    free, fixed = np.flatnonzero(~held), np.flatnonzero(held)

    def solve(force: np.ndarray) -> np.ndarray:
        load.update(force)
        field[0].values = np.zeros_like(case.nodes)

        def check(dx, x, f, xtol, ftol, dof1, dof0, items):
            left = np.linalg.norm(f[dof1])
            scale = max(np.linalg.norm(f[dof0]), np.linalg.norm(force), np.linalg.norm(f + force.ravel()))
            return np.linalg.norm(dx), left / scale, left <= ftol * scale

        found = felupe.newtonraphson(
            items=[body, load],
            x0=field,
            dof1=free,
            dof0=fixed,
            ext0=np.zeros(len(fixed)),
            check=check,
            tol=case.tolerance,
            solver=solve_symmetric,
            kwargs={"parallel": True},
            plugins=[felupe.LinesearchPlugin()],
            verbose=0,
        )
        return found.x[0].values

    return solve


if __name__ == "__main__":
    serve_loads(set_up_solver)
