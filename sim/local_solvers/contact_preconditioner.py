"""Preconditioner with contact: the undeformed stiffness plus the curvature of a barrier on few nodes.

    (K0 + E D E')^-1 = H - H E (1 + D C)^-1 D E' H,    H = K0^-1,  C = E' H E:

Woodbury 1950, with D positive semi-definite. A factor of only K0 lacks contact, which is a thousand times as stiff.
"""

import numpy as np
import warp as wp
from scipy.linalg import lu_factor, lu_solve

from ..discretisation.problem import Problem
from ..discretisation.term import LocalBarrier
from ..linalg.compliance import Compliance
from ..linalg.pcg import BlockJacobi, Preconditioner
from ..runtime.threads import limit_to_one_thread
from .contact_descent import ContactDescent
from .contact_forces import FORCES


class ContactPreconditioner:
    """Preconditioner with contact for a single load case; larger batches use the undeformed preconditioner.

    Parameters
    ----------
    base
        Preconditioner of the undeformed mesh.
    compliance
        Compliance of the undeformed mesh at the touchable nodes.
    barrier
        Barrier of the tools.
    """

    on_device = False

    def __init__(self, base: Preconditioner, compliance: Compliance, barrier: LocalBarrier):
        self._rest, self._compliance, self._barrier = base, compliance, barrier

        self._felt: tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]] | None = None

    def prepare(self, problem: Problem, columns: int) -> None:
        """Compute D, the curvature of the barrier, at the last linearisation."""
        self._rest.prepare(problem, columns)
        self._felt = None
        if columns == 1:
            nodes, curvature = self._barrier.get_active_stiffness()
            if 0 < len(nodes) <= FORCES.max_capacity:
                # BLAS threads wait for one another, very long where other processes use their cores.
                with limit_to_one_thread():
                    rows = (3 * nodes[:, None] + np.arange(3)).ravel()
                    own = self._compliance.build_matrix(np.isin(np.arange(len(self._compliance.rows) // 3), nodes))
                    whole = np.eye(len(curvature)) + curvature @ own[np.ix_(rows, rows)]
                    self._felt = nodes, curvature, lu_factor(whole)

    def apply(self, r: wp.array, case_mask: np.ndarray, out: wp.array) -> None:
        """Compute out by the undeformed inverse of r minus the Woodbury correction for the touched nodes."""
        self._rest.apply(r, case_mask, out)
        if self._felt is not None:
            z, (nodes, curvature, whole) = out.numpy(), self._felt
            force = np.zeros((len(self._compliance.rows) // 3, 3))
            own = z[self._compliance.rows, 0].reshape(-1, 3)[nodes].ravel()
            with limit_to_one_thread():
                force[nodes] = lu_solve(whole, curvature @ own).reshape(-1, 3)
                out.assign(z - self._compliance.compute_full_motion(force.reshape(-1, 1)))


def build_contact_preconditioner(
    problem: Problem, base: Preconditioner, contact: ContactDescent | None
) -> Preconditioner:
    """Return a preconditioner with tool contact, from `contact`, or from a tool barrier if there is another barrier.

    If the skull can also separate, the undeformed stiffness includes half of the skull's contact stiffness.
    """
    if contact is not None:
        return ContactPreconditioner(base, contact.compliance, contact.barrier)
    tools = [barrier for barrier in problem.barriers if isinstance(barrier, LocalBarrier)]
    if len(problem.barriers) == 1 or len(tools) != 1 or isinstance(base, BlockJacobi):
        return base
    (tool,) = tools
    return ContactPreconditioner(base, Compliance(problem, base, tool.touchable_nodes), tool)
