"""Deformation models under forces: linear models with a compliance matrix, and models that iterate to equilibrium."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache, partial
from threading import RLock
from typing import Any

import numpy as np
import warp as wp

from ..anatomy import Anatomy
from ..arguments import check_vertex_numbers
from ..compile import check_causes, compile_problem
from ..deformation import Cost, Deformation, Outcome, join_deformations
from ..diagnostics.stretch import TissueStretch
from ..discretisation.footprint import ContactSurface, compute_push_reactions
from ..discretisation.inverted_elements import InversionCounter
from ..discretisation.problem import Problem
from ..discretisation.space import Discretisation, discretise
from ..discretisation.term import Cases
from ..effects import Effect, Elasticity
from ..errors import InputError
from ..geometry.tetmesh import TetMesh
from ..loads import Loads, Nodal, Pushed, check_field
from ..minimisers.residual import measure_residual
from ..runtime.columns import unstack_columns
from ..runtime.device import Device, find_device
from ..runtime.memory import measure_free_bytes
from ..runtime.method_lock import lock_method
from ..runtime.views import to_view
from .linear_body import LinearBody, build_linear_body, check_effects

Respond = Callable[[LinearBody, np.ndarray], np.ndarray]
"""Function (body, nodes (n,)) that returns displacements (a, 3, n, 3) [m/N] under unit forces at `body.loaded`."""


@dataclass(frozen=True, eq=False)
class Relaxation:
    """Iterative method that approaches the equilibrium.

    Parameters
    ----------
    element
        Element type of the `Discretisation`.
    build_solver
        Function that returns the solver of a problem: (number b of load cases) -> displacements (3N, b) [m], steps.
    tolerance
        Relative residual at which a load case counts as converged.
    """

    element: str
    build_solver: Callable[[Problem, Discretisation, Elasticity], Callable[[int], tuple[wp.array, int]]]
    tolerance: float


class _ForceModel(ABC):
    """Base class of deformation models under forces; inversion and strain are measured in the elements of `space`."""

    def __init__(self, name: str, anatomy: Anatomy, effects: Iterable[Effect], space: Discretisation, device: Device):
        self._name, self.anatomy, self.effects, self.lock = name, anatomy, tuple(effects), RLock()
        self._surface = ContactSurface(anatomy.mesh.nodes, anatomy.mesh.surface, device)
        self._stretch, self._inversion = TissueStretch(space, device), InversionCounter(space, device)

    @lock_method
    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        """Return the deformation under every load case; `start` is ignored.

        Raises
        ------
        InputError
            No effect uses a load, the model does not support a load, or the mesh does not have a vertex.
        """
        check_causes(self.effects, loads)
        for cause in loads.causes:
            if not isinstance(cause, Pushed | Nodal):
                raise InputError(f"{self._name} does not compute {type(cause).__name__}: use finite elements.")
        count = len(self.anatomy.mesh.nodes)
        return self._deform(loads, np.arange(count) if at is None else check_vertex_numbers("at", at, count))

    @abstractmethod
    def _deform(self, loads: Loads, nodes: np.ndarray) -> Deformation:
        """Return the deformation under `loads` at the vertices `nodes` (n,)."""

    def _measure_result(self, loads: Loads, u: wp.array, outcome: np.ndarray) -> dict[str, Any]:
        """Return `Deformation` fields, by name, for displacements u (3N, b) [m] of the watched elements.

        `outcome` (b,) applies to load cases without inverted or overstrained elements.
        """
        strains, inverted = self._stretch.measure_stretch(u), self._inversion.count(u)
        outcome[self._stretch.is_beyond_range(strains["strained"])] = Outcome.OVERSTRAINED
        outcome[inverted > 0] = Outcome.INVERTED
        reaction = compute_push_reactions(self._surface, loads)
        return {"outcome": tuple(outcome), "time": loads.times, "reaction": reaction, "inverted": inverted, **strains}


class RelaxationModel(_ForceModel):
    """Deformation model that iterates from the undeformed state towards equilibrium under forces.

    The result is the state after the last step.

    Parameters
    ----------
    name
        Name of the family, for messages.
    anatomy, effects, device, batch
        Arguments of `Fem`. Only forces on tissue that is fixed to bone are supported.
    method
        Iterative method.

    Raises
    ------
    InputError
        The method does not support an effect, or `Fem` rejects the input.
    """

    def __init__(
        self, name: str, anatomy: Anatomy, effects: Iterable[Effect], method: Relaxation, device: str, batch: int = 64
    ):
        effects = tuple(effects)
        tissue, on = check_effects(name, effects), find_device(device, "float64")
        space = discretise(anatomy.mesh, method.element)
        super().__init__(name, anatomy, effects, space, on)
        self._source, self._batch, self._tolerance = f"{name} ({tissue})", batch, method.tolerance
        self._problem = compile_problem(effects, anatomy, on, space, self._surface)
        self._relax = method.build_solver(self._problem, space, tissue)

    def _deform(self, loads: Loads, nodes: np.ndarray) -> Deformation:
        firsts = range(0, max(1, len(loads)), self._batch)
        return join_deformations([self._solve(loads.select(slice(k, k + self._batch)), nodes) for k in firsts])

    def _solve(self, loads: Loads, nodes: np.ndarray) -> Deformation:
        begun, problem = time.perf_counter(), self._problem
        problem.begin(Cases(loads, np.zeros(len(loads))))
        u, steps = self._relax(len(loads))
        residual = measure_residual(problem, u)
        finite = np.isfinite(u.numpy()).all(axis=0) & np.isfinite(residual)
        to_view(u)[:, np.flatnonzero(~finite)] = 0.0
        outcome = np.full(len(loads), Outcome.BUDGET)
        outcome[residual <= self._tolerance] = Outcome.CONVERGED
        outcome[~finite] = Outcome.NOT_FINITE
        return Deformation(
            displacement=unstack_columns(problem.device, u, nodes),
            nodes=nodes,
            iterations=np.full(len(loads), steps),
            residual=residual,
            **self._measure_result(loads, u, outcome),
            cost=Cost({"steps": time.perf_counter() - begun}),
            source=self._source,
        )


class LinearModel(_ForceModel):
    """Linear deformation model with a compliance matrix for forces at the free surface.

    `inverted`, `stretch` and `strained` of a result include only tetrahedra at the free surface and in the tumour. The
    outcome ignores the error of linear theory, which is 10 % of the motion at surgical forces.

    Parameters
    ----------
    name
        Name of the family, for messages.
    anatomy, effects
        Arguments of `Fem`. Only forces on tissue that is fixed to bone are supported.
    respond
        Function that computes displacements under unit forces.
    outcome
        Outcome of load cases whose tissue is neither inverted nor overstrained.

    Raises
    ------
    InputError
        `build_linear_body` or `respond` rejects the input. In `deform`: a load is neither `Pushed` nor `Nodal`, or a
        force acts at a vertex inside the body.
    """

    def __init__(self, name: str, anatomy: Anatomy, effects: Iterable[Effect], respond: Respond, outcome: Outcome):
        effects, mesh = tuple(effects), anatomy.mesh
        self._body, self._good = build_linear_body(name, anatomy, effects), outcome
        self._respond = lru_cache(2)(partial(self._build_response_table, respond))
        free = np.isin(mesh.tets, self._body.loaded).any(axis=1) | anatomy.in_tumour
        self._watched, table = np.unique(mesh.tets[free].astype(np.int64), return_inverse=True)
        part = discretise(TetMesh(mesh.nodes[self._watched], table.reshape(-1, 4), mesh.region[free]), "p1")
        super().__init__(name, anatomy, effects, part, find_device("cpu", "float64"))
        self._respond(self._watched.tobytes())

    def _deform(self, loads: Loads, nodes: np.ndarray) -> Deformation:
        begun, force = time.perf_counter(), self._compute_forces(loads)
        acting = np.flatnonzero(force.any(axis=(0, 2)))
        watched = self._compute_motion(force, acting, self._watched)
        known = np.isin(nodes, self._watched).all()
        place = np.searchsorted(self._watched, nodes) if known else nodes
        every = np.arange(len(self.anatomy.mesh.nodes))
        u = self._surface.device.upload(watched.reshape(len(loads), 3 * len(self._watched)).T)
        return Deformation(
            displacement=(watched if known else self._compute_motion(force, acting, every))[:, place],
            nodes=nodes,
            iterations=np.zeros(len(loads), int),
            residual=np.full(len(loads), np.nan),
            **self._measure_result(loads, u, np.full(len(loads), self._good)),
            cost=Cost({"response": time.perf_counter() - begun}),
            source=f"{self._name} ({self._body.tissue})",
        )

    def _build_response_table(self, respond: Respond, vertices: bytes) -> np.ndarray:
        """Return the responses at `vertices` (n,), given as bytes of int64; responses of fixed vertices are zero."""
        nodes = np.frombuffer(vertices, np.int64)
        needed = 2 * 9 * 8 * len(self._body.loaded) * len(nodes)
        if needed > measure_free_bytes(self._surface.device):
            raise InputError(
                f"{self._name} needs {needed / 2**30:.1f} GiB for the table of this mesh: use finite elements, or a "
                "mesh with fewer vertices."
            )
        table = respond(self._body, nodes)
        table[:, :, self._body.fixed[nodes]] = 0.0
        return table

    def _compute_motion(self, force: np.ndarray, loaded_rows: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """Return displacements (B, n, 3) [m] of `nodes` under forces (B, a, 3) [N], nonzero only at `loaded_rows`."""
        table = self._respond(nodes.tobytes())[loaded_rows]
        return np.tensordot(force[:, loaded_rows], table, axes=2)

    def _compute_forces(self, loads: Loads) -> np.ndarray:
        """Return the forces (B, a, 3) [N] at `body.loaded`; forces at fixed vertices have no effect."""
        acting, count = self._body.loaded, len(self.anatomy.mesh.nodes)
        force = np.zeros((len(loads), len(acting), 3))
        for cause in loads.causes:
            if isinstance(cause, Pushed):
                weight = self._surface.find_footprints(cause.point, cause.footprint).to_matrix(count)[:, acting]
                force += weight.toarray()[:, :, None] * cause.force[:, None]
            if isinstance(cause, Nodal):
                check_field("Nodal.force", cause.force, count)
                inside = np.setdiff1d(np.flatnonzero(cause.force.any(axis=(0, 2)) & ~self._body.fixed), acting)
                if len(inside):
                    raise InputError(
                        f"{self._name} computes forces on the free surface; vertex {inside[0]} lies inside: use finite "
                        "elements (--deformer fem)."
                    )
                force += cause.force[:, acting]
        return force
