"""Energy term of a condensed exterior: Schur complement of its undeformed stiffness on the shared nodes."""

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..discretisation.term import Cases
from ..runtime.columns import add_dots, add_rows, combine_columns, is_workspace_width, take_rows
from ..runtime.dense_product import build_product
from ..runtime.device import Device


class Exterior:
    """Energy term of the linear exterior of a mesh part: u . F u / 2 on selected rows of u.

    Parameters
    ----------
    rows
        Unique rows (m,) among the 3N unknowns of the part.
    stiffness
        Symmetric stiffness F (m, m) [N/m].
    count
        Number of unknowns 3N.
    device
        Device of the arrays.
    """

    name = "exterior"
    constant, passive, steep = False, True, False

    def __init__(self, rows: np.ndarray, stiffness: np.ndarray, count: int, device: Device):
        self._device = device
        self._rest = rows, stiffness, count
        self._rows = device.upload(rows, wp.int32)
        self._product = build_product(stiffness, device)
        self._rooms: dict[int, tuple[wp.array, wp.array]] = {}

    def begin(self, cases: Cases) -> None:
        """Do nothing, since the exterior has no history variables."""

    def keep(self, columns: np.ndarray) -> None:
        """Do nothing, since F is the same in all load cases."""

    def energy(self, u: wp.array, out: wp.array) -> None:
        """Add the energy: E += u . F u / 2."""
        x, force = self._multiply_rows(u)
        add_dots(self._device, combine_columns(self._device, x, -0.5, x, x), force, out)

    def add_gradient(self, u: wp.array, out: wp.array) -> None:
        """Add the gradient: f += F u."""
        _, force = self._multiply_rows(u)
        add_rows(self._device, force, self._rows, out)

    def linearise(self, u: wp.array, definite: wp.array) -> None:
        """Do nothing, since the tangent stiffness F is constant."""

    def add_curvature(self, p: wp.array, out: wp.array) -> None:
        """Add the tangent stiffness times p: f += F p."""
        self.add_gradient(p, out)

    def add_diagonal(self, out: wp.array) -> None:
        """Add the diagonal blocks of F."""
        rows, stiffness, count = self._rest
        blocks = np.zeros((count // 3, 3, 3))
        same = rows[:, None] // 3 == rows // 3
        first, second = np.nonzero(same)
        blocks[rows[first] // 3, rows[first] % 3, rows[second] % 3] = stiffness[same]
        out.assign(out.numpy() + blocks[:, None])

    def rest_curvature(self) -> sp.csc_array:
        """Return F as a matrix on all rows (3N, 3N)."""
        rows, stiffness, count = self._rest
        place = np.repeat(rows, len(rows)), np.tile(rows, len(rows))
        return sp.csc_array(sp.coo_array((stiffness.ravel(), place), shape=(count, count)))

    def longest_step(self, u: wp.array, du: wp.array, out: wp.array) -> None:
        """Do nothing, since the exterior does not limit the step."""

    def end(self, u: wp.array) -> None:
        """Return None, since the exterior has no history variables."""

    def _multiply_rows(self, u: wp.array) -> tuple[wp.array, wp.array]:
        """Return the rows (m, b) of u, and F times these rows, in a workspace reused for the same batch width."""
        shape = (len(self._rows), u.shape[1])
        if u.shape[1] not in self._rooms:
            self._rooms = {width: room for width, room in self._rooms.items() if is_workspace_width(width)}
            self._rooms[u.shape[1]] = self._device.allocate(*shape), self._device.allocate(*shape)
        x, force = self._rooms[u.shape[1]]
        self._product(take_rows(self._device, u, self._rows, x), force)
        return x, force
