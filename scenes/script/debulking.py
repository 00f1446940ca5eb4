"""Schedule of a resection: a corridor to the tumour, and the tumour in shares."""

from dataclasses import dataclass

import numpy as np

from sim.anatomy import Anatomy
from sim.effects import Resection
from sim.errors import InputError

from .craniotomy_frame import build_craniotomy_frame


@dataclass(frozen=True)
class Debulking:
    """Resection of a corridor to the tumour, then of the tumour from the top, in equal shares; one share remains.

    Parameters
    ----------
    times
        Time of each step [s], in order: the corridor, then one share after another.
    corridor
        Radius of the corridor [m]; larger on coarse meshes.
    """

    times: tuple[float, ...]
    corridor: float = 5e-3

    def count_done(self, time: float) -> int:
        """Count the steps done at a time [s]."""
        return int(np.searchsorted(self.times, time, side="right"))

    def build_resection(self, anatomy: Anatomy) -> Resection:
        """Select the tetrahedra of each step.

        Raises
        ------
        InputError
            No open cortex, or a tumour with too few tetrahedra for the shares.
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
