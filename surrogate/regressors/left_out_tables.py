"""Tables without some of their places: interpolated from the other places, for models that are scored on these."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from sim.errors import InputError

# Axes along which places spread by less than this share of the widest are none: a flat cortex has two.
FLAT = 1e-6


def filled(points: np.ndarray, table: np.ndarray, left_out: np.ndarray) -> np.ndarray:
    """A table without the rows of the places that are `left_out`: there the others are interpolated.

    By cubic radial basis functions with a linear polynomial (Duchon 1977, "Splines minimizing rotation-invariant
    semi-norms"), which reproduce fields that are linear in the place.

    Parameters
    ----------
    points
        (P, 3) [m].
    table
        (P, ...) of any unit.
    left_out
        (P,) bool.

    Raises
    ------
    InputError
        Every place is left out.
    """
    if not left_out.any():
        return table
    if left_out.all():
        raise InputError(
            "the discs left out hold all places of the cortex at which the finite elements were asked, so that nothing "
            "is known outside: leave out fewer or smaller discs."
        )
    known = points[~left_out]
    middle, length = known.mean(axis=0), np.ptp(points, axis=0).max()
    _, size, axes = np.linalg.svd(known - middle, full_matrices=False)
    axes = axes[size > FLAT * max(size[0], np.finfo(float).tiny)]

    def at(where: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        tail = np.column_stack([np.ones(len(where)), (where - middle) @ axes.T / length])
        return (cdist(where, known) / length) ** 3, tail

    kernel, tail = at(known)
    corner = np.zeros((tail.shape[1], tail.shape[1]))
    matrix = np.block([[kernel, tail], [tail.T, corner]])
    weights = np.linalg.solve(matrix, np.hstack(at(points[left_out])).T)[: len(known)].T
    out = table.copy()
    out[left_out] = (weights @ table[~left_out].reshape(len(known), -1)).reshape(-1, *table.shape[1:])
    return out
