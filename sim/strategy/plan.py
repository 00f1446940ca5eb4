"""Selection and order of the solvers for a load, with a description in sentences."""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from enum import Enum
from functools import cache, partial

import warp as wp

from ..accuracy import Accuracy
from ..discretisation.problem import Problem
from ..discretisation.space import Discretisation
from ..discretisation.term import LocalBarrier
from ..effects import Effect
from ..linalg.multifrontal import SparseFactor
from ..linalg.multigrid import TwoLevelCycle
from ..linalg.pcg import BlockJacobi, Preconditioner
from ..linalg.preconditioner import get_preconditioner_name, is_exact
from ..local_solvers.batch_elimination import BatchElimination, build_batch_elimination, has_small_opening
from ..local_solvers.clamped_elimination import ClampedElimination
from ..local_solvers.strained_descent import StrainedDescent, build_strained_part
from .captured_frame import MAX_FRAME_EVALUATIONS

Alone = ClampedElimination | StrainedDescent
"""Type of the local solvers for a single load."""


@dataclass(frozen=True)
class PlanLimits:
    """Limits on which the choice of solvers depends."""

    min_shared_cases: int = 16  # Load cases from which the set-up of a shared local subproblem pays.
    max_evaluations: int = 60  # Maximum residual evaluations before Newton-CG on the CPU.
    # The same on CUDA, where a small batch costs almost as much as one load case, so that Newton-CG comes late.
    max_cuda_evaluations: int = 800
    # With a smaller budget of outer iterations only Newton-CG is used: its steps are longer.
    min_outer_iterations: int = 10


PLAN_LIMITS = PlanLimits()


class SolverStep(Enum):
    """Solvers that may be tried for a load; the value of each member is its description."""

    NEAR = "nonlinear elimination: the tissue near the opening, shared by all loads, is a local subproblem"
    STRAINED = "L-BFGS from a stiffness that is updated at the few hundred nodes with the largest strain"
    CLAMPED = "nonlinear elimination: the tissue near the load, clamped at its boundary, is a local subproblem"
    CONTACT = "proximal quasi-Newton: the nodes in contact with tools are solved separately from the tissue"
    FRAME = "a live frame, one captured graph on the GPU"
    LBFGS = "L-BFGS from the undeformed stiffness"
    NEWTON = "Newton-CG in a trust region"


@dataclass(frozen=True)
class SolverPlan:
    """Plan of the solvers for all loads on one mesh, with their limits.

    Parameters
    ----------
    preconditioner
        Name of the preconditioner, from `get_preconditioner_name`.
    batch_solver, single_solver
        Local solver that is tried first for `PLAN_LIMITS.min_shared_cases` loads or more, and for one load; or None.
    contact_solver
        Solver that is tried first for loads with tools of prescribed pose; None without such tools.
    uses_lbfgs
        True if L-BFGS is tried before Newton-CG.
    captures_frames, updates_model
        True if a load that starts from a previous solution is solved by a captured graph on the GPU; True if this graph
        updates the stiffness of strained tissue.
    max_evaluations, max_outer, max_load_steps
        Maximum number of residual evaluations before Newton-CG, of Newton iterations, and of load steps.
    batch
        Maximum number of loads solved together.
    """

    preconditioner: str
    batch_solver: SolverStep | None
    single_solver: SolverStep | None
    contact_solver: SolverStep | None
    uses_lbfgs: bool
    captures_frames: bool
    updates_model: bool
    max_evaluations: int
    max_outer: int
    max_load_steps: int
    batch: int

    def choose_local_solver(self, case_count: int) -> SolverStep | None:
        """Return the local solver that is tried first for `case_count` loads together, or None."""
        single = self.single_solver if case_count == 1 else None
        return self.batch_solver if case_count >= PLAN_LIMITS.min_shared_cases else single

    def list_steps(self, count: int, imposed: bool = False) -> tuple[SolverStep, ...]:
        """Return the solvers for `count` loads together, in order; `imposed` is True if loads prescribe motion."""
        if imposed or not self.uses_lbfgs:
            return (SolverStep.NEWTON,)
        first = self.choose_local_solver(count)
        return (*([] if first is None else [first]), SolverStep.LBFGS, SolverStep.NEWTON)

    def explain(self) -> tuple[str, ...]:
        """Return a description of the plan in sentences."""
        lines = [f"The undeformed stiffness is prepared once ({self.preconditioner}); every solver starts from it."]
        if self.captures_frames:
            knows = ". It updates the stiffness of the tissue that the last load strained" if self.updates_model else ""
            lines.append(f"A load that follows another is solved as {SolverStep.FRAME.value}{knows}.")
        if self.contact_solver:
            lines.append(f"Tools are moved by pose. Every load begins with {self.contact_solver.value}.")
            lines.append(f"{SolverStep.NEWTON.value} solves the loads that remain.")
        elif not self.uses_lbfgs:
            lines.append(f"Every load is solved by {SolverStep.NEWTON.value}, in at most {self.max_outer} iterations.")
        else:
            if self.batch_solver:
                lines.append(
                    f"Batches of {PLAN_LIMITS.min_shared_cases} loads and more begin with {self.batch_solver.value}."
                )
            if self.single_solver:
                lines.append(f"A single load begins with {self.single_solver.value}.")
            lines.append(f"{SolverStep.LBFGS.value} takes what is left, in at most {self.max_evaluations} evaluations.")
            lines.append(f"{SolverStep.NEWTON.value} solves what remains, in at most {self.max_outer} iterations.")
            lines.append(f"Loads that prescribe motion are solved by {SolverStep.NEWTON.value} alone.")
        if self.max_load_steps:
            lines.append(
                "A load without equilibrium is solved again from the undeformed state, and then in load steps: at most "
                f"{self.max_load_steps}."
            )
        together = f"Up to {self.batch} loads are" if self.batch > 1 else "One load is"
        lines.append(f"{together} solved at a time.")
        return tuple(lines)


def choose_plan(
    problem: Problem,
    preconditioner: Preconditioner,
    space: Discretisation,
    accuracy: Accuracy,
    batch: int,
    is_live: bool = False,
    excluded: Collection[SolverStep] = (),
) -> SolverPlan:
    """Return the solver plan of a problem; solvers are chosen only here.

    `batch` loads are solved together unless a solver handles loads one by one; loads arrive one at a time if `is_live`.
    Solvers in `excluded` are not used, except Newton-CG, which cannot be excluded.
    """
    cuda, exact = problem.device.on_cuda, is_exact(preconditioner)
    elastic = problem.can_accelerate  # local solvers handle elastic terms only
    small = elastic and has_small_opening(space, problem.constraint)
    strained = small and exact and space.element == "smoothed" and SolverStep.STRAINED not in excluded
    single = None
    if elastic and not cuda:
        if space.element == "p2" and isinstance(preconditioner, TwoLevelCycle):
            single = SolverStep.CLAMPED
        elif is_live and strained:
            single = SolverStep.STRAINED
    contact = None
    if problem.barriers:
        # The contact model supports one barrier, and a preconditioner that is the same for every state.
        alike = not isinstance(preconditioner, BlockJacobi)
        one = len(problem.barriers) == 1 and isinstance(problem.barriers[0], LocalBarrier)
        contact = SolverStep.CONTACT if one and alike else SolverStep.NEWTON
    following = cuda and exact and elastic and can_capture(space, accuracy) and wp.is_conditional_graph_supported()
    quick = not problem.is_steep and not problem.barriers and accuracy.outer >= PLAN_LIMITS.min_outer_iterations
    single, contact = None if single in excluded else single, SolverStep.NEWTON if contact in excluded else contact
    most = PLAN_LIMITS.max_cuda_evaluations if cuda else PLAN_LIMITS.max_evaluations
    most = most if accuracy.evaluations is None else min(most, accuracy.evaluations)
    return SolverPlan(
        preconditioner=get_preconditioner_name(preconditioner),
        batch_solver=SolverStep.NEAR if small and exact and SolverStep.NEAR not in excluded else None,
        single_solver=single,
        contact_solver=contact,
        uses_lbfgs=quick and most > 0 and SolverStep.LBFGS not in excluded,
        captures_frames=following and most >= MAX_FRAME_EVALUATIONS and SolverStep.FRAME not in excluded,
        updates_model=strained,
        max_evaluations=most,
        max_outer=accuracy.outer,
        max_load_steps=accuracy.steps,
        # Each load has its own local subproblem, or its own factor of the tangent stiffness.
        batch=1 if single is SolverStep.CLAMPED or (contact is SolverStep.CONTACT and exact and not cuda) else batch,
    )


def can_capture(space: Discretisation, accuracy: Accuracy) -> bool:
    """Return True if frames can be captured: all nodes are mesh vertices, and the iteration limits permit L-BFGS."""
    return not len(space.edges) and accuracy.outer >= PLAN_LIMITS.min_outer_iterations


def build_local_solvers(
    plan: SolverPlan, problem: Problem, preconditioner: Preconditioner, effects: Iterable[Effect], space: Discretisation
) -> tuple[Callable[[], BatchElimination | None], Alone | None]:
    """Return the local solvers of a plan: a function that builds the solver for many loads; the solver for one load."""
    build = partial(build_batch_elimination, problem, preconditioner, effects, space)
    near = cache(build if plan.batch_solver else lambda: None)
    if plan.single_solver is SolverStep.CLAMPED:
        return near, ClampedElimination(problem, preconditioner, effects, space)
    if plan.single_solver is SolverStep.STRAINED:
        assert isinstance(preconditioner, SparseFactor)
        return near, StrainedDescent(problem, preconditioner, build_strained_part(problem, preconditioner, space))
    return near, None
