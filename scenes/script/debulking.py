"""Schedule of a resection: first a corridor to the tumour, then equal parts of the tumour."""

from dataclasses import dataclass

import numpy as np

from sim.anatomy import Anatomy
from sim.effects import Resection
from sim.errors import InputError

from .craniotomy_frame import build_craniotomy_frame


@dataclass(frozen=True)
class Debulking:
    """Resection of a corridor to the tumour, then of equal parts of the tumour from its top; the last part remains.

    Parameters
    ----------
    times
        Ascending times of the steps [s]: first the corridor, then the parts of the tumour.
    corridor
        Minimum radius of the corridor [m]; on coarse meshes the corridor is wider.
    """

    times: tuple[float, ...]
    corridor: float = 5e-3

    def count_done(self, time: float) -> int:
        """Return the number of completed steps at a time [s]."""
        return int(np.searchsorted(self.times, time, side="right"))

    def build_resection(self, anatomy: Anatomy) -> Resection:
        """Build the resection: the tetrahedra that each step removes from an anatomy.

        Raises
        ------
        InputError
            The anatomy has no open cortex, or its tumour has fewer tetrahedra than there are parts.
        """
        mesh, site = anatomy.mesh, build_craniotomy_frame(anatomy)
        tumour = np.flatnonzero(anatomy.in_tumour)
        shares = len(self.times)
        if len(tumour) < shares:
            raise InputError(f"the tumour has {len(tumour)} tetrahedra, and {shares} shares are asked for: mesh finer.")
        middle = mesh.nodes[mesh.tets].mean(axis=1)
        # Straight from the middle of the open cortex to that of the tumour.
        way = middle[tumour].mean(axis=0) - site.origin
        length = np.linalg.norm(way)
        along = (middle - site.origin) @ way / length
        across = np.linalg.norm(middle - site.origin - np.outer(along, way / length), axis=1)
        radius = max(self.corridor, float(np.cbrt(6.0 * mesh.volumes.mean())))
        on_the_way = (across < radius) & (along < length) & ~anatomy.in_tumour
        from_the_top = tumour[np.argsort(along[tumour], kind="stable")]
        *taken, _ = np.array_split(from_the_top, shares)
        return Resection(tuple(tuple(step.tolist()) for step in (np.flatnonzero(on_the_way), *taken)))

    done = count_done  # Former names, for one release.
