"""The published test: every force position is left out in turn, and answered by a model that never saw it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim.anatomy import Anatomy
from sim.deformation import Deformation, join_deformations
from sim.errors import InputError
from sim.loads import Loads
from surrogate.data.cortex_patch import find_nearest
from surrogate.data.indentation import get_only_pushes

from .models import Published, published_model

# Positions closer than this are one [m]; the published protocol has eleven.
SAME, MOST = 1e-6, 11


@dataclass(frozen=True, eq=False)
class InTurn:
    """Models of one body as one `Deformer`: a load is answered by the one that was trained without its position.

    Parameters
    ----------
    positions
        (m, 3) [m].
    models
        m models of the same vertices, each trained without the loads at its position.
    """

    positions: np.ndarray
    models: tuple[Published, ...]

    @property
    def anatomy(self) -> Anatomy:
        """The body that they were trained on."""
        return self.models[0].anatomy

    @property
    def nodes(self) -> np.ndarray:
        """(k,) the vertices that they know."""
        return self.models[0].nodes

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        """Predict the static answer to `Pushed` loads, a load elsewhere by the nearest position's model.

        Raises
        ------
        InputError
            Loads of another kind, or a vertex in `at` that the models do not know.
        """
        position = find_nearest(get_only_pushes(loads).point, self.positions)[0]
        rows = [np.flatnonzero(position == which) for which in np.unique(position)]
        answers = [self.models[position[some[0]]].deform(loads.select(some), at=at) for some in rows]
        return join_deformations(answers).select(np.argsort(np.concatenate(rows)))


def positions_of(loads: Loads) -> np.ndarray:
    """The distinct points (m, 3) [m] of the loads, in an order that depends on nothing else."""
    whole = np.round(get_only_pushes(loads).point / SAME).astype(np.int64)
    return get_only_pushes(loads).point[np.unique(whole, axis=0, return_index=True)[1]]


def trained_in_turn(
    name: str, anatomy: Anatomy, loads: Loads, truth: np.ndarray, progress: Callable[[], object] = lambda: None
) -> InTurn:
    """Train `name` once for each position, on the loads at the others; `truth` (B, k, 3) [m] is of `published_nodes`.

    Raises
    ------
    InputError
        An unknown learner, loads of another kind; one position, or more than `MOST`: not the published protocol.
    """
    positions = positions_of(loads)
    if not 2 <= len(positions) <= MOST:
        raise InputError(
            f"the loads have {len(positions)} positions, and leaving out one in turn takes 2 to {MOST}: simulate "
            "--preset seed."
        )
    position = find_nearest(get_only_pushes(loads).point, positions)[0]
    models = []
    for which in range(len(positions)):
        others = np.flatnonzero(position != which)
        models.append(published_model(name, anatomy, loads.select(others), truth[others], progress))
    return InTurn(positions, tuple(models))
