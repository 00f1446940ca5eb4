"""Debonding of brain from skull: overloaded bonds fail, and the tissue then slides on the skull or separates."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np
import warp as wp

from .accuracy import TRAIN, Accuracy
from .anatomy import Anatomy
from .deformation import Deformation
from .diagnostics.bond_traction import BondTraction
from .discretisation.term import Cases
from .effects import Bonded, Effect, Slide
from .errors import InputError
from .fem import Fem
from .loads import Loads


@dataclass(frozen=True)
class Debonding:
    """Patch size and convergence of debonding.

    Parameters
    ----------
    max_solves
        Maximum number of solves.
    penetration_tolerance
        Tolerance of penetration into the skull by debonded vertices [m].
    tension_tolerance
        Tolerance of tension on a sliding vertex, as a fraction of the largest compression.
    averaging_radius
        Averaging radius of tractions [m]. Bonds fail in patches of this size, independent of the mesh size.
    """

    max_solves: int = 60
    penetration_tolerance: float = 1e-7
    tension_tolerance: float = 1e-3
    averaging_radius: float = 5e-3


TEARING = Debonding()
"""Default debonding options."""


@dataclass(frozen=True, eq=False)
class DebondedSolution:
    """Solution of one load after debonding: no intact bond exceeds its strength.

    Parameters
    ----------
    deformation
        Equilibrium; its `bond` is the largest traction ratio of intact bonds.
    sliding, free
        Debonded mesh vertices (n,): those that slide on the skull without friction, and those separated from the skull.
    rounds
        Number of solves.
    converged
        True if the sets of bonded, sliding and separated vertices have stopped changing.
    """

    deformation: Deformation
    sliding: np.ndarray
    free: np.ndarray
    rounds: int
    converged: bool

    # Former names, for one release.
    answer, rested = property(attrgetter("deformation")), property(attrgetter("converged"))


def solve_with_debonding(
    anatomy: Anatomy,
    effects: Sequence[Effect],
    loads: Loads,
    accuracy: Accuracy = TRAIN,
    device: str = "auto",
    element: str | None = None,
    tearing: Debonding = TEARING,
) -> DebondedSolution:
    """Solve one load with debonding, by an active set iteration over bonded, sliding and separated vertices.

    Bonds above their strength fail. Sliding vertices under tension separate. Separated vertices that would penetrate
    the skull slide. Failure is brittle and irreversible. The skull is represented by tangent planes at the undeformed
    positions, without a gap. With a strength near zero the skull can only press.

    Parameters
    ----------
    effects
        Effects of the scene, including `Bonded`, which defines the bond strengths.
    loads
        Loads with one load case.
    tearing
        Patch size and convergence criteria.

    Returns
    -------
    DebondedSolution
        Solution after debonding, debonded vertices, and convergence.

    Raises
    ------
    InputError
        There is more than one load, no `Bonded` effect, or the brain separates completely. Errors of `Fem.deform`.

    Examples
    --------
    >>> from scenes import get_template_path
    >>> from sim import BRAIN, build_push_effects, open_cortex, push, read_anatomy, solve_with_debonding
    >>> anatomy = read_anatomy(get_template_path())
    >>> place, effects = open_cortex(anatomy).place(), build_push_effects(anatomy, BRAIN)
    >>> found = solve_with_debonding(anatomy, effects, push(place.point, 0.3 * place.inward, 7e-3), element="p1")
    >>> found.converged, len(found.sliding), len(found.free)
    (True, 0, 0)
    """
    if len(loads) != 1:
        raise InputError(f"{len(loads)} loads debond separately: give one at a time.")
    skull = next((effect for effect in effects if isinstance(effect, Bonded)), None)
    if skull is None:
        raise InputError("there is no bond: add Bonded with its strengths.")
    others = tuple(effect for effect in effects if effect is not skull)
    covered = (anatomy.slide_normal != 0.0).any(axis=1)
    bonded, sliding = covered, np.zeros_like(covered)
    last, rounds = None, 0
    while True:
        rounds += 1
        held = anatomy.fixed | bonded[:, None]
        body = replace(anatomy, fixed=held, slide_normal=np.where(sliding[:, None], anatomy.slide_normal, 0.0))
        fem = Fem(body, (*others, Slide()), accuracy, device, element=element)
        last = fem.deform(loads, start=last)
        force = _compute_reactions(fem, loads, last)
        share = _compute_traction_ratios(skull, anatomy, fem, bonded, force, tearing.averaging_radius)
        pull = (_sum_at_vertices(fem, force) * anatomy.slide_normal).sum(axis=1)
        holding = bonded & (share <= 1.0)
        pressed = (bonded & ~holding | sliding) & (pull <= tearing.tension_tolerance * -pull.min())
        passing = (last.displacement[0] * anatomy.slide_normal).sum(axis=1) > tearing.penetration_tolerance
        pressed |= covered & ~bonded & ~sliding & passing
        converged = bool((holding == bonded).all() and (pressed == sliding).all())
        if converged or rounds == tearing.max_solves or not last.outcome[0].good:
            break
        bonded, sliding = holding, pressed
    most, off = share[bonded].max(initial=0.0), covered & ~bonded & ~sliding
    return DebondedSolution(
        replace(last, bond=np.array([most])), np.flatnonzero(sliding), np.flatnonzero(off), rounds, converged
    )


def _compute_reactions(fem: Fem, loads: Loads, deformation: Deformation) -> wp.array:
    """Return the gradient of the energy (3N, 1) [N] at the solution: the reaction forces of the constraints."""
    problem = fem.problem
    problem.begin(Cases(loads, deformation.time, deformation.memory))
    return problem.gradient(problem.device.upload(fem.guess(loads, deformation)))


def _compute_traction_ratios(
    skull: Bonded, anatomy: Anatomy, fem: Fem, bonded: np.ndarray, force: wp.array, radius: float
) -> np.ndarray:
    """Return the traction ratio (V,) of each bonded vertex: mean traction around it / strength.

    The averages include only bonds that are intact.
    """
    body = replace(anatomy, slide_normal=np.where(bonded[:, None], anatomy.slide_normal, 0.0))
    bond = BondTraction(skull, body, fem.space, fem.problem.device, radius)
    own, out = bond.nodes < len(bonded), np.zeros(len(bonded))
    out[bond.nodes[own]] = bond.compute_ratios(force)[own, 0]
    return out


def _sum_at_vertices(fem: Fem, force: wp.array) -> np.ndarray:
    """Return the forces at mesh vertices (V, 3) [N]; forces at mid-edge nodes are divided equally between both ends."""
    whole, count = force.numpy().reshape(-1, 3).astype(np.float64), len(fem.anatomy.mesh.nodes)
    out = whole[:count].copy()
    np.add.at(out, fem.space.edges, 0.5 * whole[count:, None])
    return out
