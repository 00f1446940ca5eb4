"""Which solvers answer a load, and in which order: one table, which can be read as sentences."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from enum import Enum
from functools import cache, partial

import warp as wp

from ..accuracy import Accuracy
from ..discretisation.problem import Problem
from ..discretisation.space import Discretisation
from ..discretisation.term import Local
from ..effects import Effect
from ..linalg.multifrontal import Factor
from ..linalg.multigrid import TwoLevel
from ..linalg.pcg import BlockJacobi, Preconditioner
from ..linalg.preconditioner import is_exact, name_of
from ..local_solvers.batch_elimination import BatchElimination, build_batch_elimination, has_small_opening
from ..local_solvers.clamped_elimination import ClampedElimination
from ..local_solvers.strained_descent import StrainedDescent, build_strained_part
from .captured_frame import FRAME_EVALUATIONS

Alone = ClampedElimination | StrainedDescent
"""What solves a single load by itself."""
# So many load cases are worth the set-up of a local problem that they share.
WORTH = 16
# Evaluations of the whole body before Newton. On CUDA, where few columns cost hardly less than one, it comes last.
EVALUATIONS, EVALUATIONS_ON_CUDA = 60, 800
# A budget of fewer outer iterations is Newton's alone: its steps lead farther.
FEWEST = 10


class SolverStep(Enum):
    """What may be tried for a load; the value says what it is."""

    NEAR = "nonlinear elimination: the tissue near the opening, which all loads share, is solved by itself"
    STRAINED = "L-BFGS from a stiffness that knows the few hundred nodes that the load strains most"
    CLAMPED = "nonlinear elimination: the tissue near the load, clamped at its rim, is solved by itself"
    CONTACT = "proximal quasi-Newton: the nodes that tools touch are solved apart from the tissue"
    FRAME = "a live frame: one graph that was captured on the card"
    LBFGS = "L-BFGS from the stiffness at rest"
    NEWTON = "Newton-CG in a trust region"


@dataclass(frozen=True)
class SolverPlan:
    """How loads on one body are solved.

    Parameters
    ----------
    preconditioner
        What `name_of` calls the stiffness at rest as it is inverted.
    many, single
        What is tried first of `WORTH` loads or more, and of one; None: nothing is solved by itself.
    contact
        What is tried first of loads whose tools are moved by pose; None where no tool is.
    quick
        Whether L-BFGS is tried before Newton-CG.
    frames, strained
        Whether loads that follow another are answered by a captured graph on the card; whether it knows strained
        tissue.
    evaluations, outer, load_steps
        Most evaluations of the body's forces before Newton-CG, iterations of that, and load steps.
    batch
        Most loads that are solved together.
    """

    preconditioner: str
    many: SolverStep | None
    single: SolverStep | None
    contact: SolverStep | None
    quick: bool
    frames: bool
    strained: bool
    evaluations: int
    outer: int
    load_steps: int
    batch: int

    def local(self, count: int) -> SolverStep | None:
        """What is tried first of so many loads together."""
        return self.many if count >= WORTH else self.single if count == 1 else None

    def steps(self, count: int, imposed: bool = False) -> tuple[SolverStep, ...]:
        """What is tried for so many loads together, in this order; `imposed` if they prescribe motion."""
        if imposed or not self.quick:
            return (SolverStep.NEWTON,)
        first = self.local(count)
        return (*([] if first is None else [first]), SolverStep.LBFGS, SolverStep.NEWTON)

    def explain(self) -> tuple[str, ...]:
        """Return the same in sentences."""
        lines = [f"The stiffness at rest is prepared once ({self.preconditioner}); every solver starts from it."]
        if self.frames:
            knows = ". It knows which tissue the last load strained" if self.strained else ""
            lines.append(f"A load that follows another is {SolverStep.FRAME.value}{knows}.")
        if self.contact:
            lines.append(f"Tools are moved by pose. Every load begins with {self.contact.value}.")
            lines.append(f"{SolverStep.NEWTON.value} takes what that leaves, load by load.")
        elif not self.quick:
            lines.append(f"Every load is solved by {SolverStep.NEWTON.value}, in at most {self.outer} iterations.")
        else:
            if self.many:
                lines.append(f"Batches of {WORTH} loads and more begin with {self.many.value}.")
            if self.single:
                lines.append(f"A single load begins with {self.single.value}.")
            lines.append(f"{SolverStep.LBFGS.value} takes what is left, in at most {self.evaluations} evaluations.")
            lines.append(f"{SolverStep.NEWTON.value} takes what that leaves, in at most {self.outer} iterations.")
            lines.append(f"Loads that prescribe motion go to {SolverStep.NEWTON.value} at once.")
        if self.load_steps:
            lines.append(
                "A load that ends without equilibrium is tried again from rest, and then in load steps: at most "
                f"{self.load_steps}."
            )
        together = f"Up to {self.batch} loads are" if self.batch > 1 else "One load is"
        lines.append(f"{together} solved at a time.")
        return tuple(lines)


def plan_for(
    problem: Problem,
    preconditioner: Preconditioner,
    space: Discretisation,
    accuracy: Accuracy,
    batch: int,
    live: bool = False,
    avoid: Collection[SolverStep] = (),
) -> SolverPlan:
    """Choose the solvers of a problem: the one place where this is decided.

    `batch` loads are solved together where nothing solves them one by one; `live` ones come one at a time. What is to
    be avoided is not tried; Newton-CG always is.
    """
    cuda, exact = problem.device.on_cuda, is_exact(preconditioner)
    elastic = problem.plain  # what is solved by itself is elastic, and nothing else
    small = elastic and has_small_opening(space, problem.constraint)
    strained = small and exact and space.element == "smoothed" and SolverStep.STRAINED not in avoid
    single = None
    if elastic and not cuda:
        if space.element == "p2" and isinstance(preconditioner, TwoLevel):
            single = SolverStep.CLAMPED
        elif live and strained:
            single = SolverStep.STRAINED
    contact = None
    if problem.barriers:
        # The model of contact knows one barrier, and needs a preconditioner that is alike at every state.
        alike = not isinstance(preconditioner, BlockJacobi)
        one = len(problem.barriers) == 1 and isinstance(problem.barriers[0], Local)
        contact = SolverStep.CONTACT if one and alike else SolverStep.NEWTON
    following = cuda and exact and elastic and can_follow(space, accuracy) and wp.is_conditional_graph_supported()
    quick = not problem.steep and not problem.barriers and accuracy.outer >= FEWEST
    single, contact = None if single in avoid else single, SolverStep.NEWTON if contact in avoid else contact
    most = EVALUATIONS_ON_CUDA if cuda else EVALUATIONS
    most = most if accuracy.evaluations is None else min(most, accuracy.evaluations)
    return SolverPlan(
        preconditioner=name_of(preconditioner),
        many=SolverStep.NEAR if small and exact and SolverStep.NEAR not in avoid else None,
        single=single,
        contact=contact,
        quick=quick and most > 0 and SolverStep.LBFGS not in avoid,
        frames=following and most >= FRAME_EVALUATIONS and SolverStep.FRAME not in avoid,
        strained=strained,
        evaluations=most,
        outer=accuracy.outer,
        load_steps=accuracy.steps,
        batch=1 if single is SolverStep.CLAMPED else batch,  # each load has a part of its own
    )


def can_follow(space: Discretisation, accuracy: Accuracy) -> bool:
    """Whether frames can be captured: of nodes that are the mesh's own, with a budget to be spent elsewhere."""
    return not len(space.edges) and accuracy.outer >= FEWEST


def build_local_solvers(
    plan: SolverPlan, problem: Problem, preconditioner: Preconditioner, effects: Iterable[Effect], space: Discretisation
) -> tuple[Callable[[], BatchElimination | None], Alone | None]:
    """What a plan solves by itself: for many loads, made when it is asked for first, and for a single one."""
    near = cache(
        partial(build_batch_elimination, problem, preconditioner, effects, space) if plan.many else lambda: None
    )
    if plan.single is SolverStep.CLAMPED:
        return near, ClampedElimination(problem, preconditioner, effects, space)
    if plan.single is SolverStep.STRAINED:
        assert isinstance(preconditioner, Factor)
        return near, StrainedDescent(problem, preconditioner, build_strained_part(problem, preconditioner, space))
    return near, None
