"""FEM solver for deformations: warm starts, batches, and load stepping if Newton's method fails."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property, lru_cache
from threading import RLock

import numpy as np
import scipy.sparse as sp

from .accuracy import TRAIN, Accuracy
from .anatomy import Anatomy
from .arguments import check_integer, check_vertex_numbers
from .compile import check_causes, compile_problem
from .deformation import Cost, Deformation, check_start, join_deformations
from .diagnostics.deformed_tissue import Diagnostics
from .discretisation.footprint import ContactSurface, compute_push_reactions
from .discretisation.inverted_elements import InversionCounter
from .discretisation.problem import Problem
from .discretisation.space import discretise
from .discretisation.term import Cases
from .effects import Effect, Elasticity
from .elements import OTHER_METHODS
from .errors import InputError
from .linalg.preconditioner import choose_preconditioner
from .linalg.rest_solver import RestStiffnessSolver
from .loads import Displaced, Loads, Nodal, Pushed
from .minimisers.lbfgs import MAX_CARRIED
from .minimisers.power_series import OutputFunctionals, count_terms, expand_taylor, list_factors
from .minimisers.residual import measure_residual
from .runtime.columns import unstack_columns
from .runtime.device import find_device
from .runtime.memory import check_fits, choose_batch_size, measure_free_bytes
from .runtime.method_lock import lock_method
from .runtime.threads import limit_to_one_thread
from .strategy.bone import solve_without_bone
from .strategy.extrapolation import as_pushes, compute_directions, extrapolate_start
from .strategy.frame_sequence import FrameSequence, build_frame_sequence
from .strategy.plan import SolverPlan, SolverStep, build_local_solvers, choose_plan
from .strategy.solver_result import SolverResult
from .strategy.strategy import Strategy
from .strategy.time_steps import MAX_PRECONDITIONERS, NoMotionStep, group_time_steps

# Key in the memory: displacements (B, E, 3) [m] of mid-edge nodes relative to the centres of their edges.
MID_EDGE_KEY = "mid-edge nodes"


class Fem:
    """FEM deformation model that computes the static equilibrium, or one time step if the effects require time steps.

    Instances are thread-safe: calls are serialised by `lock`, and results do not depend on other threads. To use
    several CPU cores at once, create one `Fem` per thread.

    Parameters
    ----------
    anatomy
        Anatomy to be deformed.
    effects
        Effects of the scene; the solver compiles only the terms of these effects.
    accuracy
        Tolerance, iteration limits and precision.
    device
        Device name: "auto", "cpu", "cuda" or "cuda:1".
    batch
        Maximum number of load cases solved together; None: a device-dependent default. On the CPU, load cases of
        quadratic elements with multigrid levels are solved one by one.
    element
        Name in `elements.ELEMENTS` or `OTHER_METHODS`; None: the recommended one, or p2 for a mesh with mid-edge nodes.
    live
        True if loads arrive one at a time. On a CPU the first then takes 1 s more, the others 1/3 to 2/3 of the time.
    avoid
        Solvers to skip, for measurements and checks; Newton-CG cannot be skipped.
    stiff_as
        Another `Fem` with the same undeformed stiffness, whose factorisation is reused; its swelling, say, may differ.

    Raises
    ------
    InputError
        Effects or elements are not supported, the body is not fixed, the device is not available, or `batch` < 1.

    Examples
    --------
    >>> from scenes import get_template_path
    >>> from sim import Bonded, Elasticity, Fem, Held, ToolForce, open_cortex, push, read_anatomy
    >>> anatomy = read_anatomy(get_template_path())
    >>> place = open_cortex(anatomy).place(right_mm=0, up_mm=0)
    >>> fem = Fem(anatomy, [Elasticity(), Held(), Bonded(), ToolForce()], device="cpu", element="p1")
    >>> result = fem.deform(push(place.point, 0.1 * place.inward, footprint=7e-3), at=anatomy.tumour_nodes)
    >>> print(f"{1e3 * np.linalg.norm(result.displacement[0].mean(axis=0)):.1f} mm; {result.outcome[0].value}")
    0.3 mm; converged to the requested tolerance
    """

    def __init__(
        self,
        anatomy: Anatomy,
        effects: Iterable[Effect],
        accuracy: Accuracy = TRAIN,
        device: str = "auto",
        batch: int | None = None,
        element: str | None = None,
        live: bool = False,
        avoid: Collection[SolverStep] = (),
        stiff_as: Fem | None = None,
    ):
        if not isinstance(anatomy, Anatomy):
            raise InputError(f"anatomy is {anatomy!r:.80}: give an Anatomy, such as read_anatomy(FILE.vtu) returns.")
        if not isinstance(accuracy, Accuracy):
            raise InputError(f"accuracy is {accuracy!r:.80}: give an Accuracy, such as LIVE, TRAIN or REFERENCE.")
        if not isinstance(effects, Iterable):
            raise InputError(f"effects is {effects!r:.80}: give a tuple of effects.")
        self.lock = RLock()
        self._anatomy = anatomy
        self.effects = tuple(effects)
        self.accuracy = accuracy
        self.space = discretise(anatomy.mesh, element)
        self._skin = ContactSurface(self.space.nodes, self.space.surface, find_device(device, accuracy.precision))
        problem = compile_problem(self.effects, anatomy, self._skin.device, self.space, self._skin)
        shared = stiff_as and stiff_as.strategy.preconditioner
        preconditioner = shared or choose_preconditioner(problem, self.space, self._build_linear_stiffness)
        if batch is None:
            batch = choose_batch_size(problem.rows, problem.device, measure_free_bytes(problem.device))
        plan = choose_plan(problem, preconditioner, self.space, accuracy, check_integer("batch", batch, 1), live, avoid)
        parts = build_local_solvers(plan, problem, preconditioner, self.effects, self.space)
        if problem.device.on_cuda:
            parts[0]()  # prepare for batches on a GPU; on the CPU, parts are built when first used
        self._diagnostics = Diagnostics(anatomy, self.space, self.effects, problem.device, accuracy.limit_strain)
        inversion = InversionCounter(self.space, problem.device, problem.prevents_inversion)
        self.strategy = Strategy(problem, preconditioner, inversion, accuracy, plan, *parts)
        """Solvers of the plan, tried in order."""
        self._paced = lru_cache(MAX_PRECONDITIONERS)(self._build_strategy)
        self._resting = RestStiffnessSolver(problem, preconditioner, accuracy.inner)

    @property
    def plan(self) -> SolverPlan:
        """Solvers that are tried, in order."""
        return self.strategy.plan

    @property
    def batch(self) -> int:
        """Maximum number of load cases solved together."""
        return self.plan.batch

    @cached_property
    def description(self) -> str:
        """Description of element and tissue, included in every result."""
        return describe_solver(self.space.element, self.effects)

    @property
    def problem(self) -> Problem:
        """Boundary value problem of the anatomy and the effects."""
        return self.strategy.problem

    @property
    def anatomy(self) -> Anatomy:
        """Undeformed anatomy of the model."""
        return self._anatomy

    @lock_method
    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        """Return the equilibrium, or the next time step under inertia, of every load case.

        `start` (B rows, all vertices) gives the initial guess and the history variables; without `start` the anatomy is
        initially undeformed. `at` (n,) selects the mesh vertices of the result.

        Raises
        ------
        InputError
            No effect uses a load, a load does not touch the body, or `start` does not match. The problem exceeds the
            memory, or `at` contains a vertex that the mesh does not have.
        """
        check_causes(self.effects, loads)
        at = None if at is None else self._check_vertices(at)
        if start is not None and self.frame_sequence is not None:
            answer = self.frame_sequence.solve_frame(loads, start, lambda: self.guess(loads, start))
            if answer is not None:
                return answer if at is None else answer.restrict(at)
        check_fits(self.problem.rows, self.batch, len(loads), self.problem.device, self.strategy.kept_bytes)
        last = None if start is None else self.guess(loads, start)
        cases = Cases(loads, np.zeros(len(loads)))
        if start is not None and last is not None:
            before = last.T.reshape(len(loads), self.space.count, 3)
            cases = Cases(loads, start.time, start.memory, before, warm=start.warm)
        some = group_time_steps(cases.steps, self.batch) if self.problem.depends_on_step else None
        batches, parts = some or [(math.inf, rows) for rows in self._iterate_batches(len(loads))], []
        for step, rows in batches:
            guess = None if last is None else last[:, rows]
            parts.append(self._solve(self._get_strategy(step), cases.select(rows), guess, at))
        # Warm-start data of several batches are dropped, as they may differ.
        answer = parts[0] if len(parts) == 1 else join_deformations([replace(part, warm={}) for part in parts])
        return answer.select(np.argsort(np.concatenate([rows for _, rows in some]))) if some else answer

    def _get_strategy(self, time_step: float) -> Strategy | NoMotionStep:
        """Return the strategy with a preconditioner for the time step [s]; an infinite step is a static problem."""
        if time_step == 0.0 or time_step == math.inf:
            return self.strategy if time_step else NoMotionStep(self.problem, self.strategy.inversion)
        return self._paced(time_step)

    def _build_strategy(self, time_step: float) -> Strategy:
        preconditioner = choose_preconditioner(self.problem, self.space, self._build_linear_stiffness, time_step)
        return Strategy(self.problem, preconditioner, self.strategy.inversion, self.accuracy, self.plan)

    def _iterate_batches(self, count: int) -> Iterator[slice]:
        """Yield the slice of load cases of each batch; at least one slice, even without load cases."""
        return (slice(first, first + self.batch) for first in range(0, max(count, 1), self.batch))

    @cached_property
    def frame_sequence(self) -> FrameSequence | None:
        """Solver for frame sequences on CUDA; None if the plan does not include such a solver, as on the CPU."""
        if not self.plan.captures_frames:
            return None
        return build_frame_sequence(
            self.strategy, self.space, self._skin, self._diagnostics, self.lock, self.description
        )

    def _check_vertices(self, vertices: np.ndarray) -> np.ndarray:
        return check_vertex_numbers("at", vertices, len(self._anatomy.mesh.nodes))

    def _check_static(self, loads: Loads) -> None:
        check_causes(self.effects, loads)
        if self.problem.depends_on_step:
            raise InputError("solutions under Inertia are time steps without static equilibrium: remove Inertia.")

    def _build_linear_stiffness(self, time_step: float) -> sp.csc_array:
        """Return the undeformed stiffness (3V, 3V) [N/m] of linear tetrahedra on this mesh, for a time step [s]."""
        linear = discretise(self._anatomy.mesh, "p1")
        return compile_problem(self.effects, self._anatomy, self._skin.device, linear).rest_curvature(time_step)

    @lock_method
    def residual(self, loads: Loads, answer: Deformation) -> np.ndarray:
        """Return the relative residual (B,) of solutions at all vertices, in the precision of this solver.

        Raises
        ------
        InputError
            See `deform`; also if effects include inertia, whose solutions are time steps without static equilibrium.
        """
        self._check_static(loads)
        self.problem.begin(Cases(loads, answer.time, answer.memory))
        return measure_residual(self.problem, self.problem.device.upload(self.guess(loads, answer)))

    @lock_method
    def build_reading(self, nodes: np.ndarray, modes: np.ndarray) -> OutputFunctionals:
        """Return functionals for `compute_series` that project the motion of vertices `nodes` (n,) on modes (r, n, 3).

        Raises
        ------
        InputError
            The mesh does not have a vertex, or the problem exceeds the memory.
        """
        nodes = self._check_vertices(nodes)
        device, rows = self.problem.device, (3 * nodes[:, None] + np.arange(3)).ravel()
        check_fits(self.problem.rows, self.batch, len(modes), device, self.strategy.kept_bytes)
        answers = np.empty((len(modes), self.problem.rows))
        for some in self._iterate_batches(len(modes)):
            force = np.zeros((self.problem.rows, len(modes[some])))
            force[rows] = modes[some].reshape(-1, len(rows)).T
            on_device = device.upload(force)
            self.problem.constraint.project(on_device)
            answers[some] = self._resting.solve(on_device).numpy().T
        return OutputFunctionals(answers, device)

    @lock_method
    def compute_series(self, loads: Loads, orders: int, reading: OutputFunctionals, sizes: int = 1) -> np.ndarray:
        """Return power series coefficients (G, terms, r) of the projected solution in the magnitudes of the loads.

        Every `sizes` successive loads form one of G groups. If m loads of a group act at once, scaled by s_1 ... s_m,
        the solution is the sum of the terms times the monomials of s_1 ... s_m, in the order of their degree. One load
        gives s u_1 + s^2 u_2 + ...; three loads give 3 + 6 + 10 terms up to third order. Convergence is not checked.

        Raises
        ------
        InputError
            See `deform`. Loads are not forces, such as prescribed motion, or a group is incomplete. The solver has
            precision float32, whose round-off would dominate the higher orders.
        """
        check_causes(self.effects, loads)
        if not self.problem.can_accelerate:
            raise InputError("a power series requires elastic bodies under forces only: remove the other effects.")
        if self.problem.device.precision != "float64":
            raise InputError("a power series requires float64: use an Accuracy of that precision.")
        for cause in loads.causes:
            if not isinstance(cause, Pushed | Nodal):
                raise InputError(f"a power series requires `Pushed` or `Nodal` loads, not `{type(cause).__name__}`.")
        if len(loads) % sizes:
            raise InputError(f"{len(loads)} loads cannot be grouped by {sizes}: give a multiple of {sizes}.")
        widest = len(list_factors(sizes, orders))
        groups = min(len(loads) // sizes, max(1, self.batch // widest))
        columns = groups * widest
        check_fits(self.problem.rows, columns, columns, self.problem.device, self.strategy.kept_bytes)
        edge = float(np.cbrt(self._anatomy.mesh.volumes.mean() * 6.0))
        found = np.empty((len(loads) // sizes, count_terms(sizes, orders), reading.count))
        # BLAS threads wait for each other, very long if other processes use their cores.
        with limit_to_one_thread():
            for first in range(0, len(found), max(groups, 1)):
                some = loads.select(slice(first * sizes, (first + groups) * sizes))
                self.problem.begin(Cases(some, np.zeros(len(some))))
                forces = expand_taylor(self.problem, self._resting.solve, len(some), sizes, edge, orders)
                read = [reading.evaluate(force).reshape(len(some) // sizes, -1, reading.count) for force in forces]
                found[first : first + groups] = np.concatenate(read, axis=1)
        return found

    def guess(self, loads: Loads, start: Deformation) -> np.ndarray:
        """Return the displacements of a solution as columns (3N, B) [m], over all N nodes of the discretisation."""
        vertices = len(self._anatomy.mesh.nodes)
        check_start(start, len(loads), vertices)
        full = self.space.interpolate_field(start.restrict(np.arange(vertices)).displacement)
        if len(self.space.edges) and MID_EDGE_KEY in start.memory:
            full[:, vertices:] += Cases(loads, start.time, start.memory).get_past(
                MID_EDGE_KEY, (len(self.space.edges), 3)
            )
        return full.reshape(len(loads), self.problem.rows).T

    def _solve(
        self, strategy: Strategy | NoMotionStep, cases: Cases, last_u: np.ndarray | None, vertices: np.ndarray | None
    ) -> Deformation:
        clock = time.perf_counter()
        guesses = () if last_u is None else (extrapolate_start(cases.loads, last_u, cases.warm), last_u)
        found = solve_without_bone(strategy, cases, guesses)
        seconds = {"equilibrium": time.perf_counter() - clock}
        way = compute_directions(as_pushes(cases.loads), last_u, cases.warm) if len(cases.loads) <= MAX_CARRIED else {}
        return self._build_deformation(cases, found, way, vertices, seconds)

    def _build_deformation(
        self,
        cases: Cases,
        result: SolverResult,
        warm_start: Mapping[str, np.ndarray],
        vertices: np.ndarray | None,
        seconds: Mapping[str, float],
    ) -> Deformation:
        """Return the deformation of a solver result, with reactions, `warm_start` data, and `seconds` by stage."""
        solved = time.perf_counter()
        self.problem.begin(replace(cases, share=result.path_fraction, restarted=result.restarted))
        memory = dict(self.problem.end(result.u))
        displaced = cases.loads.get(Displaced) is not None
        held = self.problem.gradient(result.u) if displaced or self._diagnostics.needs_forces else None
        on_footprint = self.problem.constraint.compute_footprint_force(held) if displaced else None
        touching = [term.compute_reaction(result.u) for term in self.problem.barriers]
        reaction = np.concatenate([compute_push_reactions(self._skin, cases.loads, on_footprint), *touching], axis=1)
        nodes = np.arange(len(self._anatomy.mesh.nodes)) if vertices is None else vertices
        if vertices is None and len(self.space.edges):
            whole = unstack_columns(self.problem.device, result.u, np.arange(self.space.count))
            displacement = np.ascontiguousarray(whole[:, : len(nodes)])
            memory[MID_EDGE_KEY] = whole[:, len(nodes) :] - self.space.interpolate_field(displacement)[:, len(nodes) :]
        else:
            displacement = unstack_columns(self.problem.device, result.u, nodes)
        fields = self._diagnostics.compute_fields(result.u, held)
        return Deformation(
            displacement=displacement,
            nodes=nodes,
            outcome=tuple(self._diagnostics.mark_outcomes(result.outcome, result.inverted, fields["strained"])),
            iterations=result.iterations,
            residual=result.residual,
            time=cases.loads.times,
            reaction=reaction,
            memory=memory,
            warm={**result.warm_start, **warm_start},
            cost=Cost({**seconds, "reactions": time.perf_counter() - solved}),
            reached=result.reached,
            inverted=result.inverted,
            **fields,
            source=self.description,
        )

    reading, series = build_reading, compute_series  # Former names, for one release.


def describe_solver(element: str, effects: Iterable[Effect]) -> str:
    """Return a description of the element type and the tissue, for results, images and files."""
    tissue = next((str(effect) for effect in effects if isinstance(effect, Elasticity)), "no elasticity")
    if element in OTHER_METHODS:
        return f"{OTHER_METHODS[element]} ({tissue})"
    return f"finite elements ({element}; {tissue})"
