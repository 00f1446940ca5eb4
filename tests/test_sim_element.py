"""Every law on every element: energy and forces by definition, rigid motions, single precision."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import base_held, box, quadratic, top_forces
from oracle import EVERY_LAW, elastic_energy, internal_forces, tissue

from sim.accuracy import REFERENCE, TRAIN, Precision
from sim.compile import compile_problem
from sim.discretisation.problem import Problem
from sim.discretisation.space import discretise
from sim.effects import Elasticity, Held, NodalForce
from sim.elements import ELEMENTS
from sim.fem import Fem
from sim.geometry.tetmesh import TetMesh
from sim.loads import Loads, Nodal
from sim.material import Tissue
from sim.runtime.device import find_device

BLOCK = box((2, 2, 2), 0.1, distortion=0.15)
UPPER = BLOCK.nodes[BLOCK.tets].mean(axis=1)[:, 2] > 0.05
BLOCK = replace(BLOCK, region=UPPER.astype(int))
BODY = {"p1": BLOCK, "smoothed": BLOCK, "p2": quadratic(BLOCK, curved=0.04)}
"""Two regions; quadratic elements are curved inside."""


def laws(law: str) -> dict[int, Tissue]:
    return {0: tissue(law), 1: tissue(law, 9000.0, 0.2)}


def problem(law: str, element: str, precision: Precision = "float64") -> Problem:
    mesh = BODY[element]
    effects = Elasticity(regions=laws(law)), Held()
    return compile_problem(effects, base_held(mesh), find_device("cpu", precision), discretise(mesh, element))


def swell(mesh: TetMesh, seed: int) -> np.ndarray:
    """A smooth motion (N, 3) [m] with strains of tens of per cent, and a little noise."""
    random = np.random.default_rng(seed)
    wave = 3e-3 * np.sin(mesh.nodes @ random.normal(0.0, 40.0, (3, 3)) + random.uniform(0.0, 6.0, 3))
    return mesh.nodes @ random.normal(0.0, 0.1, (3, 3)) + wave + random.normal(0.0, 1e-4, mesh.nodes.shape)


def energy(problem: Problem, u: np.ndarray) -> float:
    return float(problem.energy(problem.device.upload(u.reshape(-1, 1)))[0])


def forces(problem: Problem, u: np.ndarray) -> np.ndarray:
    return problem.gradient(problem.device.upload(u.reshape(-1, 1))).numpy().reshape(-1, 3).astype(np.float64)


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("law", EVERY_LAW)
class TestEveryLawAndElement:
    def test_element_energy_and_forces_match_their_definition(self, law: str, element: str) -> None:
        """Against averages over edges and nodes, and shape functions, computed without the package."""
        built, mesh, u = problem(law, element), BODY[element], swell(BODY[element], 0)
        assert energy(built, u) == pytest.approx(elastic_energy(mesh, laws(law), u, element), rel=1e-12)
        expected = internal_forces(mesh, laws(law), u, element)
        np.testing.assert_allclose(forces(built, u), expected, atol=1e-12 * np.abs(expected).max())

    def test_rigid_motion_has_no_elastic_energy(self, law: str, element: str) -> None:
        """The elements' forces have no resultant and no moment; rotating the deformed body rotates them."""
        built, mesh, u = problem(law, element), BODY[element], swell(BODY[element], 1)
        f, x = forces(built, u), mesh.nodes + u
        assert np.abs(f.sum(axis=0)).max() < 1e-12 * np.abs(f).sum()
        if law == "linear":
            assert np.abs(np.cross(mesh.nodes, f).sum(axis=0)).max() < 1e-13 * np.abs(f).sum()
            return
        assert np.abs(np.cross(x, f).sum(axis=0)).max() < 1e-13 * np.abs(f).sum()
        Q, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
        Q *= np.linalg.det(Q)
        turned = x @ Q.T + [0.02, -0.01, 0.03] - mesh.nodes
        assert energy(built, turned) == pytest.approx(energy(built, u), rel=1e-10)
        np.testing.assert_allclose(forces(built, turned), f @ Q.T, atol=1e-9 * np.abs(f).max())

    def test_single_precision_forces_agree_with_double(self, law: str, element: str) -> None:
        """Forces at large strain, and at small strain, where nothing may cancel."""
        double, single = problem(law, element), problem(law, element, "float32")
        for size in (1.0, 1e-4):
            u = size * swell(BODY[element], 3)
            exact = forces(double, u.astype(np.float32))
            assert np.linalg.norm(forces(single, u) - exact) < 1e-5 * np.linalg.norm(exact)

    def test_single_precision_equilibria_agree_with_double(self, law: str, element: str) -> None:
        mesh = BODY[element]
        loads = Loads((Nodal(top_forces(mesh, np.array([[0.02, 0.0, -0.1], [0.1, -0.05, 0.1]]))),))
        effects = Elasticity(regions=laws(law)), Held(), NodalForce()
        exact, found = (
            Fem(base_held(mesh), effects, accuracy, "cpu", element=element).deform(loads)
            for accuracy in (REFERENCE, TRAIN)
        )
        assert all(outcome.good for outcome in (*exact.outcome, *found.outcome))
        off = np.abs(found.displacement - exact.displacement).max()
        assert off < 1e-3 * np.abs(exact.displacement).max()
