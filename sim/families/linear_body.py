"""Data of linear deformation models: fixed vertices, loaded vertices and Lamé parameters."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from ..anatomy import Anatomy
from ..compile import collect_laws, compile_problem
from ..discretisation.problem import Problem
from ..effects import Bonded, Effect, Elasticity, Held, NodalForce, ToolForce
from ..errors import InputError
from ..runtime.device import find_device

SUPPORTED = (Elasticity, Held, Bonded, ToolForce, NodalForce)
"""Effects that models other than finite elements support: forces on tissue that is fixed to bone."""


@dataclass(frozen=True, eq=False)
class LinearBody:
    """Elastic body with fixed vertices under forces on its free surface.

    Parameters
    ----------
    anatomy
        Mesh of V vertices.
    fixed
        Mask (V,) of vertices that do not move.
    loaded
        Sorted vertices (a,) of the surface that are not fixed; forces may act there.
    lame
        Lamé parameters mu, lambda [Pa] at small strain, by region label.
    tissue
        Tissue of the regions.
    """

    anatomy: Anatomy
    fixed: np.ndarray
    loaded: np.ndarray
    lame: Mapping[int, tuple[float, float]]
    tissue: Elasticity


def check_effects(family: str, effects: Iterable[Effect]) -> Elasticity:
    """Return the tissue among the effects; reject effects that the model family `family` does not support.

    Raises
    ------
    InputError
        An effect is not supported, the tissue relaxes, or there is no tissue.
    """
    effects = tuple(effects)
    other = next((type(effect).__name__ for effect in effects if not isinstance(effect, SUPPORTED)), None)
    if other is not None:
        names = ", ".join(kind.__name__ for kind in SUPPORTED)
        raise InputError(f"{family} does not compute {other}, only {names}: use finite elements (--deformer fem).")
    tissue = next((effect for effect in effects if isinstance(effect, Elasticity)), None)
    if tissue is None:
        raise InputError("no effect resists deformation: add Elasticity.")
    if any(law is not None and law.prony for law in (tissue.default, *tissue.regions.values())):
        raise InputError(f"{family} does not compute tissue that relaxes: remove its Prony series.")
    return tissue


def build_linear_body(family: str, anatomy: Anatomy, effects: Iterable[Effect]) -> LinearBody:
    """Return the linear body of an anatomy for the model family `family`, a name for messages.

    Raises
    ------
    InputError
        An effect is not supported or `compile_problem` rejects it. A vertex is fixed in some directions only, no
        vertex is free, or the mesh is quadratic.
    """
    effects = tuple(effects)
    tissue = check_effects(family, effects)
    if anatomy.mesh.middles is not None:
        raise InputError(f"{family} requires linear tetrahedra: use finite elements, or a mesh without mid-edge nodes.")
    problem = compile_problem(effects, anatomy, find_device("cpu", "float64"))
    still = list_fixed_vertices(family, problem) | anatomy.orphaned
    acting = np.setdiff1d(anatomy.mesh.surface, np.flatnonzero(still))
    if not len(acting):
        raise InputError(f"{family} requires a free vertex on the surface: open a craniotomy.")
    laws = collect_laws(tissue, np.unique(anatomy.mesh.region).tolist())
    return LinearBody(anatomy, still, acting, {label: law.lame for label, law in laws.items()}, tissue)


def list_fixed_vertices(family: str, problem: Problem) -> np.ndarray:
    """Return the mask (V,) of fixed vertices, for the model family `family`.

    Raises
    ------
    InputError
        A vertex is fixed in some directions only.
    """
    fixed = problem.constraint.fixed
    if (fixed.any(axis=1) != fixed.all(axis=1)).any():
        raise InputError(
            f"{family} requires vertices that are fixed in all directions or in none: use finite elements."
        )
    return np.asarray(fixed.all(axis=1))
