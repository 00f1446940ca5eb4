"""Engine of sulcus, in a separate process as its peers."""

import sys
from functools import partial

import numpy as np

from sim.accuracy import Accuracy
from sim.anatomy import Anatomy
from sim.effects import Effect, Elasticity, Held, NodalForce
from sim.fem import Fem
from sim.geometry.tetmesh import TetMesh
from sim.loads import Loads, Nodal
from sim.material import Material

from .engine_process import Case, Solve, serve_loads


def build_fem(case: Case, device: str = "cpu") -> Fem:
    """Build the FEM solver of a case, in double precision."""
    mesh = TetMesh(case.nodes, case.tets, np.zeros(len(case.tets), int))
    held = np.repeat(case.held[:, None], 3, axis=1)
    anatomy = Anatomy(mesh, held, np.zeros_like(mesh.nodes), ~case.held)
    tissue = Material("neo-hookean", case.young, case.poisson)
    effects: tuple[Effect, ...] = (Elasticity(tissue), Held(), NodalForce())
    # The discretisation of the peers, so that residuals can be compared.
    return Fem(anatomy, effects, Accuracy(case.tolerance), device, element="p1")


def set_up_solver(case: Case, device: str = "cpu") -> Solve:
    """Prepare kernels and the factor for all loads."""
    fem = build_fem(case, device)
    return lambda force: fem.deform(Loads((Nodal(force[None]),))).displacement[0]


if __name__ == "__main__":
    serve_loads(partial(set_up_solver, device="cuda" if "cuda" in sys.argv else "cpu"))
