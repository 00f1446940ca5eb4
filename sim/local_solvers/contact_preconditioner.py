"""A preconditioner that knows what is touched: the rest stiffness and the curvature of a barrier on few nodes.

    (K0 + E D E')^-1 = H - H E (1 + D C)^-1 D E' H,    H = K0^-1,  C = E' H E:

Woodbury 1950, with D positive semi-definite. A factor knows nothing of contact, a thousand times as stiff.
"""

from __future__ import annotations

import numpy as np
import warp as wp
from scipy.linalg import lu_factor, lu_solve

from ..discretisation.problem import Problem
from ..discretisation.term import Local
from ..linalg.compliance import Compliance
from ..linalg.pcg import BlockJacobi, Preconditioner
from ..runtime.threads import limit_to_one_thread
from .contact_descent import ContactDescent
from .contact_forces import FORCES


class ContactPreconditioner:
    """A Preconditioner of batches of one column; of wider ones it is the rest's alone.

    Parameters
    ----------
    rest
        Of the problem at rest.
    compliance
        What that does at the nodes that can be touched.
    barrier
        What touches them.
    """

    on_device = False

    def __init__(self, rest: Preconditioner, compliance: Compliance, barrier: Local):
        self._rest, self._compliance, self._barrier = rest, compliance, barrier

        self._felt: tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]] | None = None

    def prepare(self, problem: Problem, columns: int) -> None:
        """Take D where the problem was last linearised."""
        self._rest.prepare(problem, columns)
        self._felt = None
        if columns == 1:
            nodes, curvature = self._barrier.pressed()
            if 0 < len(nodes) <= FORCES.most:
                # Threads of BLAS wait for one another, ages where something else runs on their cores.
                with limit_to_one_thread():
                    rows = (3 * nodes[:, None] + np.arange(3)).ravel()
                    own = self._compliance.between(np.isin(np.arange(len(self._compliance.rows) // 3), nodes))
                    whole = np.eye(len(curvature)) + curvature @ own[np.ix_(rows, rows)]
                    self._felt = nodes, curvature, lu_factor(whole)

    def apply(self, r: wp.array, live: np.ndarray, out: wp.array) -> None:
        """What the rest does, less what the touched nodes are kept from."""
        self._rest.apply(r, live, out)
        if self._felt is not None:
            z, (nodes, curvature, whole) = out.numpy(), self._felt
            force = np.zeros((len(self._compliance.rows) // 3, 3))
            own = z[self._compliance.rows, 0].reshape(-1, 3)[nodes].ravel()
            with limit_to_one_thread():
                force[nodes] = lu_solve(whole, curvature @ own).reshape(-1, 3)
                out.assign(z - self._compliance.spread(force.reshape(-1, 1)))


def build_contact_preconditioner(
    problem: Problem, rest: Preconditioner, contact: ContactDescent | None
) -> Preconditioner:
    """Return a preconditioner that knows what tools touch: as `contact` does where that is, or beside another barrier.

    Where a skull lets go too, the rest counts it as half shut, and tools are as stiff as ever.
    """
    if contact is not None:
        return ContactPreconditioner(rest, contact.compliance, contact.barrier)
    tools = [barrier for barrier in problem.barriers if isinstance(barrier, Local)]
    if len(problem.barriers) == 1 or len(tools) != 1 or isinstance(rest, BlockJacobi):
        return rest
    (tool,) = tools
    return ContactPreconditioner(rest, Compliance(problem, rest, tool.touchable), tool)
