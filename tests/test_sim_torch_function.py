"""Equilibrium as a function of PyTorch: derivatives, types, recovery of stiffness, and messages."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from boxes import base_held, box

from sim.accuracy import REFERENCE
from sim.adjoint.torch_function import solve_equilibrium
from sim.effects import Elasticity, Held, ToolForce
from sim.errors import InputError
from sim.fem import Fem
from sim.geometry.tetmesh import TetMesh
from sim.loads import Pushed
from sim.material import MEASURED_BRAIN

BOX = box((3, 3, 3), 0.05, 0.2)
MESH = TetMesh(BOX.nodes, BOX.tets, (np.arange(len(BOX.tets)) // 6 % 27 > 18).astype(int))
FEM = Fem(
    base_held(MESH), [Elasticity(MEASURED_BRAIN), Held(), ToolForce()], replace(REFERENCE, tolerance=1e-11), "cpu"
)
POINT, RADIUS = np.array([[0.025, 0.025, 0.05], [0.03, 0.02, 0.05]]), np.array([0.01, 0.012])
FORCE = [[0.02, 0.0, -0.1], [0.0, 0.03, -0.12]]


def push_by(force: Any) -> Pushed:
    """Two pushes by forces (2, 3) [N], a tensor or an array."""
    return Pushed(POINT, force, RADIUS)


def test_derivatives_pass_the_check_of_pytorch() -> None:
    def compute_motion(force: torch.Tensor, young: torch.Tensor, poisson: torch.Tensor) -> torch.Tensor:
        tissues = {0: {"young": 1e3 * young}, 1: {"poisson": poisson}}
        return 1e3 * solve_equilibrium(FEM, [push_by(force)], tissues).sum(dim=1)

    inputs = [torch.tensor(one, dtype=torch.float64, requires_grad=True) for one in (FORCE, 3.0, 0.45)]
    assert torch.autograd.gradcheck(compute_motion, inputs, eps=1e-5, atol=1e-4, rtol=1e-5)


def test_result_and_derivatives_have_the_type_of_tensors() -> None:
    force = torch.tensor(FORCE, dtype=torch.float32, requires_grad=True)
    found = solve_equilibrium(FEM, [push_by(force)])
    assert found.dtype == torch.float32 and found.shape == (2, len(MESH.nodes), 3)
    found.norm().backward()
    assert force.grad is not None and force.grad.dtype == torch.float32 and force.grad.abs().max() > 0.0


def test_optimiser_recovers_stiffness_from_a_displacement_field() -> None:
    """Young's moduli of both regions, from 2 kPa each; L-BFGS of PyTorch."""
    truth = {0: {"young": torch.tensor(3500.0)}, 1: {"young": torch.tensor(9000.0)}}
    cause = push_by(np.array(FORCE))
    measured = solve_equilibrium(FEM, [cause], truth).to(torch.float64)
    logs = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS([logs], max_iter=30, line_search_fn="strong_wolfe", tolerance_change=1e-12)

    def evaluate() -> torch.Tensor:
        optimiser.zero_grad()
        young = 2000.0 * logs.exp()
        found = solve_equilibrium(FEM, [cause], {0: {"young": young[0]}, 1: {"young": young[1]}})
        loss = 1e6 * (found - measured).square().sum()
        loss.backward()
        return loss

    optimiser.step(evaluate)
    np.testing.assert_allclose(2000.0 * logs.detach().exp().numpy(), [3500.0, 9000.0], rtol=1e-3)


def test_unknown_parameters_and_failed_loads_are_rejected() -> None:
    cause, one = push_by(np.array(FORCE)), torch.tensor(1.0)
    with pytest.raises(InputError, match="region 5 has no parameter 'young': choose from 0: young/poisson/c1/m1/bulk"):
        solve_equilibrium(FEM, [cause], {5: {"young": one}})
    hasty = Fem(FEM.anatomy, FEM.effects, replace(REFERENCE, outer=1, steps=0, evaluations=0), "cpu", element="p1")
    with pytest.raises(InputError, match="load 0 is not converged"):
        solve_equilibrium(hasty, [cause])
