"""A bond that tears: what passes its strength lets go of the skull, slides on it or leaves it, and never passes it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from .accuracy import TRAIN, Accuracy
from .anatomy import Anatomy
from .bond import Bond
from .deformation import Deformation
from .effects import Bonded, Effect, Slide
from .errors import InputError
from .fem import Fem
from .loads import Loads
from .term import Cases

# Solves after which a tear is given up that has not come to rest; and how far what let go may pass the skull [m].
ROUNDS, THROUGH = 60, 1e-7


@dataclass(frozen=True, eq=False)
class Torn:
    """One load's answer when nothing of the bond bears more than its strength.

    Parameters
    ----------
    answer
        The equilibrium; its `bond` is the largest share that what still holds bears.
    sliding, free
        (n,) mesh vertices that let go: pressed on the skull and sliding without friction, or off it.
    rounds
        Solves that it took.
    rested
        Whether nothing changes any more.
    """

    answer: Deformation
    sliding: np.ndarray
    free: np.ndarray
    rounds: int
    rested: bool


def torn(
    anatomy: Anatomy,
    effects: Sequence[Effect],
    loads: Loads,
    accuracy: Accuracy = TRAIN,
    device: str = "auto",
    element: str | None = None,
) -> Torn:
    """Solve one load; let go what bears too much, as well as what slides and is pulled; hold what would pass the skull.

    Brittle: no energy is left in what is torn, and it does not heal. The traction is the mean over `bond.ROUND`, so
    that a tear grows by patches of that size whatever the mesh. What let go meets the plane across its normal at rest,
    without a gap: an active set of constraints, in which a strength near zero is a skull that only presses.

    Parameters
    ----------
    effects
        With `Bonded`, whose strengths count.
    loads
        One load.

    Raises
    ------
    InputError
        More loads than one, no `Bonded`, a body that tears off wholly, and as `Fem.deform`.
    """
    if len(loads) != 1:
        raise InputError(f"{len(loads)} loads tear apart from each other: give one at a time.")
    skull = next((effect for effect in effects if isinstance(effect, Bonded)), None)
    if skull is None:
        raise InputError("nothing is bonded here: add Bonded, whose strengths count.")
    others = tuple(effect for effect in effects if effect is not skull)
    covered = (anatomy.slide_normal != 0.0).any(axis=1)
    bonded, sliding = covered, np.zeros_like(covered)
    last, rounds = None, 0
    while True:
        rounds += 1
        held = anatomy.held | bonded[:, None]
        body = replace(anatomy, held=held, slide_normal=np.where(sliding[:, None], anatomy.slide_normal, 0.0))
        fem = Fem(body, (*others, Slide()), accuracy, device, element=element)
        last = fem.deform(loads, start=last)
        force = _reaction(fem, loads, last)
        share, pulled = (_round(skull, anatomy, fem, part, force) for part in (bonded, sliding))
        above = (last.displacement[0] * anatomy.slide_normal).sum(axis=1) > THROUGH
        holding = bonded & (share[0] <= 1.0)
        pressed = bonded & ~holding & (share[1] <= 0.0) | sliding & (pulled[1] <= 0.0)
        pressed |= covered & ~bonded & ~sliding & above
        rested = bool((holding == bonded).all() and (pressed == sliding).all())
        if rested or rounds == ROUNDS or not last.outcome[0].good:
            break
        bonded, sliding = holding, pressed
    most = share[0, bonded].max(initial=0.0)
    off = covered & ~bonded & ~sliding
    return Torn(replace(last, bond=np.array([most])), np.flatnonzero(sliding), np.flatnonzero(off), rounds, rested)


def _reaction(fem: Fem, loads: Loads, answer: Deformation) -> wp.array:
    """What holds the body (3N, 1) [N]."""
    problem = fem.problem
    problem.begin(Cases(loads, answer.time, answer.history))
    return problem.gradient(problem.device.array(fem.guess(loads, answer)))


def _round(skull: Bonded, anatomy: Anatomy, fem: Fem, part: np.ndarray, force: wp.array) -> np.ndarray:
    """Round each mesh vertex of a part of the wall (V,) bool: share of the strength, and pull [Pa]: (2, V).

    Means over that part alone: what has let go bears nothing.
    """
    body = replace(anatomy, slide_normal=np.where(part[:, None], anatomy.slide_normal, 0.0))
    bond, count = Bond(skull, body, fem.space, fem.problem.device), len(part)
    own = bond.nodes < count
    out = np.zeros((2, count))
    out[:, bond.nodes[own]] = [values[own, 0] for values in bond.tractions(force)]
    return out
