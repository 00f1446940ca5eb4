"""Equilibria of independent solvers (FElupe, torch-fem, scikit-fem, dolfinx, warp.fem) on a 10 cm box."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from boxes import hold

from sim.accuracy import REFERENCE, TRAIN, Accuracy
from sim.deformation import Deformation
from sim.effects import Elasticity, Held, NodalForce
from sim.fem import Fem
from sim.geometry.tetmesh import TetMesh
from sim.loads import Loads, Nodal
from sim.material import Material

DATA = Path(__file__).parent / "data"
YOUNG, POISSON = 3000.0, 0.45


@dataclass(frozen=True)
class Reference:
    """One file: the law that it was made with, the body, the loads and the answer (V, 3) [m]."""

    law: str
    mesh: TetMesh
    held: np.ndarray
    force: np.ndarray
    displacement: np.ndarray

    def solve(self, accuracy: Accuracy) -> Deformation:
        stiff = {1: Material(self.law, 10.0 * YOUNG, POISSON)} if self.mesh.region.any() else {}
        effects = Elasticity(Material(self.law, YOUNG, POISSON), stiff), Held(), NodalForce()
        fem = Fem(hold(self.mesh, self.held), effects, accuracy, "cpu", element="p1")
        return fem.deform(Loads((Nodal(self.force[None]),)))

    def error(self, deformation: Deformation) -> float:
        """In the 2-norm, relative."""
        return float(
            np.linalg.norm(deformation.displacement[0] - self.displacement) / np.linalg.norm(self.displacement)
        )


def reference(name: str, law: str) -> Reference:
    with np.load(DATA / f"box5k_{name}.npz") as data:
        held = np.zeros(len(data["nodes"]), bool)
        held[data["fixed"]] = True
        mesh = TetMesh(data["nodes"], data["tets"], data["mu"] > 1.5 * data["mu"].min())
        return Reference(law, mesh, held, data["loads"], data["displacement"])


@pytest.mark.parametrize(
    ("name", "law"),
    [("base", "neo-hookean"), ("incl", "neo-hookean"), ("snh", "stable-neo-hookean"), ("corot", "corotational")],
)
def test_equilibrium_agrees_with_independent_solver(name: str, law: str) -> None:
    case = reference(name, law)
    deformation = case.solve(REFERENCE)
    assert deformation.outcome[0].good
    assert deformation.residual[0] <= 1e-8
    assert case.error(deformation) < 1e-5


@pytest.mark.parametrize(("name", "law"), [("snh", "stable-neo-hookean"), ("corot", "corotational")])
def test_single_precision_agrees_with_independent_solver(name: str, law: str) -> None:
    case = reference(name, law)
    deformation = case.solve(TRAIN)
    assert deformation.outcome[0].good
    assert case.error(deformation) < 1e-4


def test_stiff_inclusion_changes_the_displacement() -> None:
    """Without a difference the reference would not test regions."""
    soft, stiff = reference("base", "neo-hookean"), reference("incl", "neo-hookean")
    assert stiff.mesh.region.sum() > 50
    assert np.linalg.norm(soft.displacement - stiff.displacement) > 0.05 * np.linalg.norm(soft.displacement)
