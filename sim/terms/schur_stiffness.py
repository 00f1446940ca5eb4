"""Static condensation of the surrounding body: undeformed Schur complement stiffness on the shared nodes."""

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..discretisation.term import Cases
from ..runtime.columns import add_dots, add_rows, combine_columns, is_workspace_width, take_rows
from ..runtime.dense_product import build_product
from ..runtime.device import Device


class Exterior:
    """Term for a linear surrounding body: u . F u / 2 on some rows of u.

    Parameters
    ----------
    rows
        Rows (m,) of the part's 3N unknowns, unique.
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
        """Do nothing: the exterior has no history."""

    def keep(self, columns: np.ndarray) -> None:
        """Do nothing: F is the same in all load cases."""

    def energy(self, u: wp.array, out: wp.array) -> None:
        """Add the energy: E += u . F u / 2."""
        x, force = self._multiply_rows(u)
        add_dots(self._device, combine_columns(self._device, x, -0.5, x, x), force, out)

    def add_gradient(self, u: wp.array, out: wp.array) -> None:
        """Add the gradient: f += F u."""
        _, force = self._multiply_rows(u)
        add_rows(self._device, force, self._rows, out)

    def linearise(self, u: wp.array, definite: wp.array) -> None:
        """Do nothing: the term is linear."""

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
        """Return F on all rows (3N, 3N)."""
        rows, stiffness, count = self._rest
        place = np.repeat(rows, len(rows)), np.tile(rows, len(rows))
        return sp.csc_array(sp.coo_array((stiffness.ravel(), place), shape=(count, count)))

    def longest_step(self, u: wp.array, du: wp.array, out: wp.array) -> None:
        """Do nothing: a linear term does not limit the step."""

    def end(self, u: wp.array) -> None:
        """Return None: the exterior has no history."""

    def _multiply_rows(self, u: wp.array) -> tuple[wp.array, wp.array]:
        """Return rows (m, b) of u and F times them, in a workspace reused for batches of the same width."""
        shape = (len(self._rows), u.shape[1])
        if u.shape[1] not in self._rooms:
            self._rooms = {width: room for width, room in self._rooms.items() if is_workspace_width(width)}
            self._rooms[u.shape[1]] = self._device.allocate(*shape), self._device.allocate(*shape)
        x, force = self._rooms[u.shape[1]]
        self._product(take_rows(self._device, u, self._rows, x), force)
        return x, force
