"""Equilibrium as a differentiable function of PyTorch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch

from ..compile import collect_laws
from ..deformation import Deformation
from ..effects import Elasticity
from ..errors import InputError
from ..fem import Fem
from ..loads import Cause, Loads
from .equilibrium_gradient import differentiate_equilibrium
from .tissue_gradient import find_parameter

Tissues = Mapping[int, Mapping[str, torch.Tensor]]
"""Tensors () by region label and parameter, such as {1: {"young": tensor}}."""


@dataclass(frozen=True, eq=False)
class _Inputs:
    """Solver, causes, and for each tensor its cause and array, or its region and parameter."""

    fem: Fem
    causes: tuple[Any, ...]
    arrays: tuple[tuple[int, str], ...]
    parameters: tuple[tuple[int, str], ...]


def solve_equilibrium(fem: Fem, causes: Sequence[Cause], tissues: Tissues | None = None) -> torch.Tensor:
    """Return the displacements (B, V, 3) [m] of static equilibria, which PyTorch can differentiate.

    `backward` costs one adjoint solve for each load case; see `differentiate_equilibrium`.

    Parameters
    ----------
    fem
        Solver; its device and precision are used, whatever those of the tensors.
    causes
        Causes of the loads, such as `Pushed`, whose arrays are tensors or NumPy arrays. A pose has no derivative here.
    tissues
        Parameters that replace those of regions: a solver is built for them, which takes seconds on a large mesh.

    Raises
    ------
    InputError
        A load case has no equilibrium, or a region or a parameter is unknown; see also `Fem` and `Fem.deform`.

    Examples
    --------
    >>> import torch
    >>> from scenes import get_template_path
    >>> from sim import BRAIN, Fem, Pushed, build_push_effects, open_cortex, read_anatomy, solve_equilibrium
    >>> anatomy = read_anatomy(get_template_path())
    >>> place = open_cortex(anatomy).place()
    >>> fem = Fem(anatomy, build_push_effects(anatomy, BRAIN), device="cpu", element="p1")
    >>> force = torch.tensor(0.1 * place.inward[None], requires_grad=True)
    >>> u = solve_equilibrium(fem, [Pushed(place.point[None], force, np.array([7e-3]))])
    >>> u[:, anatomy.tumour_nodes].mean(dim=1).norm().backward()
    >>> print(f"{1e3 * force.grad[0].norm():.1f} mm/N")
    3.2 mm/N
    """
    tensors: list[torch.Tensor] = []
    arrays, parameters = [], []
    plain = []
    for number, cause in enumerate(causes):
        values = {field.name: getattr(cause, field.name) for field in fields(cause)}  # pyright: ignore[reportArgumentType]
        for name, value in values.items():
            if isinstance(value, torch.Tensor):
                arrays.append((number, name))
                tensors.append(value)
                values[name] = value.detach().cpu().numpy()
        plain.append(replace(cause, **values))
    for label, row in (tissues or {}).items():
        for name, value in row.items():
            parameters.append((label, name))
            tensors.append(value)
    return _Equilibrium.apply(_Inputs(fem, tuple(plain), tuple(arrays), tuple(parameters)), *tensors)  # pyright: ignore


class _Equilibrium(torch.autograd.Function):
    """Autograd function; its inputs after `_Inputs` are the tensors of arrays, then those of parameters."""

    @staticmethod
    def forward(ctx: Any, inputs: _Inputs, *tensors: torch.Tensor) -> torch.Tensor:
        """Return the displacements (B, V, 3)."""
        values = [float(one) for one in tensors[len(inputs.arrays) :]]
        fem = _replace_parameters(inputs.fem, dict(zip(inputs.parameters, values, strict=True)))
        loads = Loads(inputs.causes)
        ctx.inputs, ctx.fem, ctx.loads, ctx.found = inputs, fem, loads, _deform(fem, loads)
        ctx.save_for_backward(*tensors)
        like = tensors[0] if tensors else torch.zeros(0, dtype=torch.float64)
        return torch.as_tensor(ctx.found.displacement).to(like)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Return the derivatives with respect to the tensors."""
        seed = grad_outputs[0].detach().cpu().numpy().astype(np.float64)
        found = differentiate_equilibrium(ctx.fem, ctx.loads, ctx.found, seed)
        every = [found.causes[number][name] for number, name in ctx.inputs.arrays]
        every += [found.regions[label][name].sum() for label, name in ctx.inputs.parameters]
        pairs = zip(every, ctx.saved_tensors, strict=True)
        return None, *(torch.as_tensor(np.asarray(value)).to(tensor).reshape(tensor.shape) for value, tensor in pairs)


def _deform(fem: Fem, loads: Loads) -> Deformation:
    """Return the equilibria; raise `InputError` if a load case has none."""
    found = fem.deform(loads)
    bad = [row for row, outcome in enumerate(found.outcome) if not outcome.good]
    if bad:
        raise InputError(f"load {bad[0]} is {found.outcome[bad[0]].value}: reduce the load or its step.")
    return found


def _replace_parameters(fem: Fem, values: Mapping[tuple[int, str], float]) -> Fem:
    """Return the solver with other parameters by region label and name; without any, the given solver."""
    if not values:
        return fem
    effect = next(effect for effect in fem.effects if isinstance(effect, Elasticity))
    laws = collect_laws(effect, np.unique(fem.anatomy.mesh.region).tolist())
    for (label, name), value in values.items():
        laws[label] = find_parameter(laws, label, name)[1](laws[label], value)
    effects = [Elasticity(None, laws) if one is effect else one for one in fem.effects]
    device = fem.problem.device.name
    return Fem(fem.anatomy, effects, fem.accuracy, device, fem.batch, fem.space.element)
