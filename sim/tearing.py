"""A bond that tears: what passes its strength lets go of the skull, slides on it or leaves it, and never passes it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from .accuracy import TRAIN, Accuracy
from .anatomy import Anatomy
from .deformation import Deformation
from .diagnostics.bond_traction import Bond
from .discretisation.term import Cases
from .effects import Bonded, Effect, Slide
from .errors import InputError
from .fem import Fem
from .loads import Loads


@dataclass(frozen=True)
class Tearing:
    """By which patches a bond tears, and when it has come to rest.

    Parameters
    ----------
    rounds
        Solves after which a tear is given up that has not come to rest.
    through
        [m] How far what let go may pass the skull.
    pull
        How strongly a vertex may be pulled that slides, as a share of what the hardest pressed one bears.
    around
        [m] Tractions are means over so far: a tear grows by patches of that size whatever the mesh.
    """

    rounds: int = 60
    through: float = 1e-7
    pull: float = 1e-3
    around: float = 5e-3


TEARING = Tearing()
"""Tears as they are followed unless others are asked for."""


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
    tearing: Tearing = TEARING,
) -> Torn:
    """Solve one load; let go what bears too much, as well as what slides and is pulled; hold what would pass the skull.

    Brittle: no energy is left in what is torn, and it does not heal. What let go
    meets the plane across its normal at rest, without a gap: these constraints are an active set. With a strength near
    zero the skull only presses.

    Parameters
    ----------
    effects
        With `Bonded`, whose strengths count.
    loads
        One load.
    tearing
        Size of the patches that tear, and when a tear has come to rest.

    Returns
    -------
    Torn
        The answer after the tear, which vertices let go, and whether nothing changes any more.

    Examples
    --------
    >>> found = torn(anatomy, pushed_effects(anatomy, BRAIN), push(point, force, footprint=6e-3))  # doctest: +SKIP
    >>> found.rested, len(found.sliding) + len(found.free)  # doctest: +SKIP

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
        share = _shares(skull, anatomy, fem, bonded, force, tearing.around)
        pull = (_at_vertices(fem, force) * anatomy.slide_normal).sum(axis=1)
        holding = bonded & (share <= 1.0)
        pressed = (bonded & ~holding | sliding) & (pull <= tearing.pull * -pull.min())
        passing = (last.displacement[0] * anatomy.slide_normal).sum(axis=1) > tearing.through
        pressed |= covered & ~bonded & ~sliding & passing
        rested = bool((holding == bonded).all() and (pressed == sliding).all())
        if rested or rounds == tearing.rounds or not last.outcome[0].good:
            break
        bonded, sliding = holding, pressed
    most = share[bonded].max(initial=0.0)
    off = covered & ~bonded & ~sliding
    return Torn(replace(last, bond=np.array([most])), np.flatnonzero(sliding), np.flatnonzero(off), rounds, rested)


def _reaction(fem: Fem, loads: Loads, answer: Deformation) -> wp.array:
    """What holds the body (3N, 1) [N]."""
    problem = fem.problem
    problem.begin(Cases(loads, answer.time, answer.memory))
    return problem.gradient(problem.device.array(fem.guess(loads, answer)))


def _shares(
    skull: Bonded, anatomy: Anatomy, fem: Fem, bonded: np.ndarray, force: wp.array, around: float
) -> np.ndarray:
    """Round each mesh vertex that is bonded, of what the bond bears, as a share of its strength: (V,).

    Means over what holds alone: what has let go bears nothing.
    """
    body = replace(anatomy, slide_normal=np.where(bonded[:, None], anatomy.slide_normal, 0.0))
    bond = Bond(skull, body, fem.space, fem.problem.device, around)
    own = bond.nodes < len(bonded)
    out = np.zeros(len(bonded))
    out[bond.nodes[own]] = bond.shares(force)[own, 0]
    return out


def _at_vertices(fem: Fem, force: wp.array) -> np.ndarray:
    """Nodal forces (V, 3) [N], those at the middle of an edge shared by its ends."""
    whole = force.numpy().reshape(-1, 3).astype(np.float64)
    count = len(fem.anatomy.mesh.nodes)
    out = whole[:count].copy()
    np.add.at(out, fem.space.edges, 0.5 * whole[count:, None])
    return out
