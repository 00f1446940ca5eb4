"""Body of a linear deformation model: fixed vertices, loaded vertices and Lamé parameters."""

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
"""Effects that models outside the finite elements compute: forces on tissue that is fixed to bone."""


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
        Vertices (a,), ascending, of the surface that is not fixed: forces act on these.
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
    """Return the tissue, if a family called `family` supports all effects.

    Raises
    ------
    InputError
        Another effect, tissue that relaxes, or no tissue.
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
    """Return the body of a family called `family`.

    Raises
    ------
    InputError
        Effects that are not supported, or that `compile_problem` rejects; vertices fixed in some directions only; no
        free vertices; a quadratic mesh.
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
    """Return the mask (V,) of vertices that are fixed, for a family called `family`.

    Raises
    ------
    InputError
        Vertices that are fixed in some directions only.
    """
    fixed = problem.constraint.fixed
    if (fixed.any(axis=1) != fixed.all(axis=1)).any():
        raise InputError(
            f"{family} requires vertices that are fixed in all directions or in none: use finite elements."
        )
    return np.asarray(fixed.all(axis=1))
