"""Deformation models that approach the equilibrium step by step without solving linear systems."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from threading import RLock

import numpy as np
import warp as wp

from ..anatomy import Anatomy
from ..arguments import check_vertex_numbers
from ..compile import check_causes, compile_problem
from ..deformation import Cost, Deformation, Outcome, join_deformations
from ..diagnostics.stretch import Stretch
from ..discretisation.footprint import ContactSurface, compute_push_reactions
from ..discretisation.inverted_elements import Inversion
from ..discretisation.problem import Problem
from ..discretisation.space import Discretisation, discretise
from ..discretisation.term import Cases
from ..effects import Effect, Elasticity
from ..loads import Loads
from ..minimisers.residual import measure_residual
from ..runtime.columns import unstack_columns
from ..runtime.device import find_device
from ..runtime.method_lock import lock_method
from ..runtime.views import view
from .linear_body import check_effects


@dataclass(frozen=True, eq=False)
class Relaxation:
    """Method that approaches the equilibrium.

    Parameters
    ----------
    element
        Element of `Discretisation`.
    prepare
        Function that returns the method for a problem: (number of load cases) -> displacements (3N, b) [m] and steps.
    tolerance
        Relative residual at which a load case counts as converged.
    """

    element: str
    prepare: Callable[[Problem, Discretisation, Elasticity], Callable[[int], tuple[wp.array, int]]]
    tolerance: float


class RelaxationModel:
    """Deformation model that approaches the equilibrium under forces from the undeformed state.

    Parameters
    ----------
    name
        Name of the family, for messages.
    anatomy, effects, device, batch
        Arguments of `Fem`; only forces on tissue that is fixed to bone.
    method
        Method that approaches the equilibrium.

    Raises
    ------
    InputError
        Effects that the method does not compute, and input that `Fem` rejects.
    """

    def __init__(
        self,
        name: str,
        anatomy: Anatomy,
        effects: Iterable[Effect],
        method: Relaxation,
        device: str = "auto",
        batch: int = 64,
    ):
        self.effects, self.lock = tuple(effects), RLock()
        self._anatomy, self._name, self._method, self._batch = anatomy, name, method, batch
        self._tissue = check_effects(name, self.effects)
        on = find_device(device, "float64")
        space = discretise(anatomy.mesh, method.element)
        self._surface = ContactSurface(space.nodes, space.surface, on)
        self._problem = compile_problem(self.effects, anatomy, on, space, self._surface)
        self._relax = method.prepare(self._problem, space, self._tissue)
        self._stretch, self._inversion = Stretch(space, on), Inversion(space, on)

    @property
    def anatomy(self) -> Anatomy:
        """Anatomy that is deformed."""
        return self._anatomy

    @lock_method
    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        """Return the state after the last step under every load case; `start` has no influence.

        Raises
        ------
        InputError
            Loads that no effect uses; a vertex that the mesh lacks.
        """
        check_causes(self.effects, loads)
        count = len(self._anatomy.mesh.nodes)
        nodes = np.arange(count) if at is None else check_vertex_numbers("at", at, count)
        firsts = range(0, max(1, len(loads)), self._batch)
        return join_deformations([self._deform(loads.select(slice(k, k + self._batch)), nodes) for k in firsts])

    def _deform(self, loads: Loads, nodes: np.ndarray) -> Deformation:
        begun, problem, device = time.perf_counter(), self._problem, self._problem.device
        problem.begin(Cases(loads, np.zeros(len(loads))))
        u, steps = self._relax(len(loads))
        residual = measure_residual(problem, u)
        finite = np.isfinite(u.numpy()).all(axis=0) & np.isfinite(residual)
        view(u)[:, np.flatnonzero(~finite)] = 0.0
        strains, inverted = self._stretch.measure(u), self._inversion.count(u)
        outcome = np.full(len(loads), Outcome.BUDGET)
        outcome[residual <= self._method.tolerance] = Outcome.CONVERGED
        outcome[self._stretch.is_beyond_range(strains["strained"])] = Outcome.OVERSTRAINED
        outcome[inverted > 0] = Outcome.INVERTED
        outcome[~finite] = Outcome.NOT_FINITE
        return Deformation(
            displacement=unstack_columns(device, u, nodes),
            nodes=nodes,
            outcome=tuple(outcome),
            iterations=np.full(len(loads), steps),
            residual=residual,
            time=loads.times,
            reaction=compute_push_reactions(self._surface, loads),
            cost=Cost({"steps": time.perf_counter() - begun}),
            inverted=inverted,
            stretch=strains["stretch"],
            strained=strains["strained"],
            source=f"{self._name} ({self._tissue})",
        )
