"""A patch of tissue that a load strains far from its rest stiffness, in equilibrium with a body that keeps its own.

C is the inverse of the body's rest stiffness at the patch's nodes, and e the motion that the rest stiffness alone would
give there. With n the internal forces of the patch's elements and K their rest stiffness, the patch moves by

    x = e + C q(x),    q(x) = n(u) + K x - n(u + x):

q is what the elements resist less than at rest, and the body answers it as any other force. This x minimises the energy
of the elements beside a quadratic one of all else, whose curvature is C^-1 - K. L-BFGS that begins from C finds it: no
step needs C^-1, for every direction is C times a force, plus steps whose forces are known.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import get_blas_funcs

from ..compile import compile_part
from ..discretisation.problem import Problem
from ..discretisation.space import Discretisation
from ..effects import Effect
from ..minimisers.compact_lbfgs import no_pairs
from ..minimisers.lbfgs_kernels import LEAST_CURVATURE
from ..minimisers.line_search import goes_too_far, kept_of


@dataclass(frozen=True)
class PatchLimits:
    """Most evaluations of a patch, and most cuts of one step."""

    evaluations: int = 150
    cuts: int = 12


class Patch:
    """Elements on some nodes of a body.

    Parameters
    ----------
    nodes
        (n,), ascending.
    part
        The elements alone.
    compliance
        C (m, m) [m/N] of the body at the nodes' rows, m = 3n.
    """

    def __init__(self, nodes: np.ndarray, part: Problem, compliance: np.ndarray):
        self.nodes, self.rows = nodes, (3 * nodes[:, None] + np.arange(3)).ravel()
        self._part, self._compliance = part, compliance
        (self._product,) = get_blas_funcs(("symv",), (compliance,))  # reads half of it
        # Arrays on the device, and the same numbers on the host: to make either anew takes as long as a product.
        self._place, self._way, self._force = (part.device.zeros(part.rows, 1) for _ in range(3))
        self._place_host, self._way_host, self._force_host = (
            array.numpy()[:, 0] for array in (self._place, self._way, self._force)
        )
        part.linearise(self._place, np.ones(1, bool))
        constraint = part.constraint
        self._bound = bool(constraint.held.any() or constraint.normal.any())

    def settled(
        self, u: np.ndarray, e: np.ndarray, force: float, limits: PatchLimits = PatchLimits()
    ) -> tuple[float, np.ndarray]:
        """A share s, and the forces f (m,) [N] by which the body moves s e + C f, at u (m,) and e (m,) [m].

        The share is as much of e as no element forbids. The forces are q but for the gradient, whose 2-norm is at most
        `force` [N]. C q would amplify what that leaves by how much stiffer than at rest the elements have become.
        """
        pairs = no_pairs(len(e), "float64")
        forces = changes = np.zeros((0, len(e)), e.dtype)  # C^-1 s of the pairs' steps s, and C^-1 w of their w = C y
        share = self._longest(u, e)
        x, beside, tried = share * e, np.zeros_like(e), 1  # beside: C^-1 (x - s e)
        start = self.excess(u, beside)
        g = self.free(self.excess(u, x) - start)
        z = self._answered(g)
        while tried < limits.evaluations and np.linalg.norm(g) > force:
            weights = pairs.weights(g)
            along_s, along_w = np.split(weights.astype(g.dtype), 2)
            d = (-z - pairs.motion(weights)).astype(g.dtype)
            pull = -g - along_s @ forces - along_w @ changes  # C^-1 d
            promised = -float(g @ d)
            if not promised > 0.0:  # round-off, or forces that are not finite
                break
            t = 1.0  # a step that an element forbids has forces that are not finite, and is cut
            for _ in range(limits.cuts):
                tried += 1
                moved = x + t * d
                new = self.free(beside + t * pull + self.excess(u, moved) - start)
                slope = float(new @ d)
                if not goes_too_far(slope, promised):
                    break
                t *= kept_of(slope, promised)
            else:
                break
            after = self._answered(new)
            if promised + slope > LEAST_CURVATURE * promised:
                pairs = pairs.and_one(t * d, new - g, after - z)
                forces, changes = (
                    np.vstack([old[-len(pairs.s) + 1 :] if len(pairs.s) > 1 else old[:0], one])
                    for old, one in ((forces, t * pull), (changes, new - g))
                )
            x, beside, g, z = moved, beside + t * pull, new, after
        return share, beside

    def _answered(self, force: np.ndarray) -> np.ndarray:
        """C force (m,) [m], of a force (m,) [N]."""
        return self._product(1.0, self._compliance.T, force).astype(force.dtype)

    def excess(self, u: np.ndarray, x: np.ndarray) -> np.ndarray:
        """n(u + x) - K x (m,)."""
        np.add(u, x, out=self._place_host)
        np.negative(x, out=self._way_host)
        self._force_host.fill(0.0)
        for term in self._part.terms:
            term.add_gradient(self._place, self._force)
            term.add_curvature(self._way, self._force)
        return self._force_host.copy()

    def _longest(self, u: np.ndarray, d: np.ndarray) -> float:
        """The longest fraction of the step d (m,) from u (m,)."""
        self._place_host[:], self._way_host[:] = u, d
        return float(self._part.longest_step(self._place, self._way)[0])

    def free(self, g: np.ndarray) -> np.ndarray:
        """The gradient (m,) along motions that the constraints leave free."""
        if not self._bound:
            return g
        self._force_host[:] = g
        self._part.constraint.project_nodes(self._force)
        return self._force_host.copy()


def patch_of(
    effects: Iterable[Effect], space: Discretisation, whole: Problem, chosen: np.ndarray, compliance: np.ndarray
) -> Patch:
    """The `chosen` (T,) bool tetrahedra of a body; `compliance` (m, m) [m/N] is the body's at their m rows, at rest."""
    nodes = np.unique(space.table[chosen])
    return Patch(nodes, compile_part(effects, space, whole, chosen, nodes), compliance)
