"""torch-fem: Newton with load increments that are shortened on failure, and a direct solver (PARDISO if installed)."""

import numpy as np
import torch
from torchfem import Solid
from torchfem.materials import Hyperelastic3D

from benchmarks.peers.engine_process import Case, Solve, serve_loads


def compute_energy_density(F: torch.Tensor, lame: torch.Tensor) -> torch.Tensor:
    """Compute the energy density [Pa] of the log neo-Hookean law, as in torch-fem's own benchmark."""
    C = F.transpose(-1, -2) @ F
    log_J = 0.5 * torch.logdet(C)
    return lame[0] / 2 * (torch.trace(C) - 3.0) - lame[0] * log_J + lame[1] / 2 * log_J**2


def set_up_solver(case: Case) -> Solve:
    """Build a solid with its assembly maps, for all loads."""
    torch.set_default_dtype(torch.float64)
    law = Hyperelastic3D(compute_energy_density, [case.mu, case.lam])
    body = Solid(torch.tensor(case.nodes), torch.tensor(case.tets, dtype=torch.int64), law)
    body.constraints = torch.tensor(np.repeat(case.held[:, None], 3, axis=1))

    @torch.no_grad()
    def solve(force: np.ndarray) -> np.ndarray:
        body.forces = torch.tensor(force)
        # Relative to the load, which is at most our scale; `rtol` is relative to a substep's start, perhaps far away.
        enough = case.tolerance * float(np.linalg.norm(force))
        return body.solve(rtol=0.0, atol=enough, method="direct")[0].numpy()

    return solve


if __name__ == "__main__":
    serve_loads(set_up_solver)
