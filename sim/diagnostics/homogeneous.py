"""Nominal stress of a tissue in homogeneous deformations: uniaxial tension or compression, and simple shear."""

import numpy as np

from ..errors import InputError
from ..material import Tissue
from ..terms.laws.conformance import build_evaluator

MAX_STEPS = 60  # Maximum number of Newton steps for the lateral stretch.
TOLERANCE = 1e-9  # Largest lateral stress, relative to the shear modulus.


def compute_uniaxial_stress(tissue: Tissue, stretch: np.ndarray) -> np.ndarray:
    """Compute the nominal stress P_11 (n,) [Pa] at stretches (n,), with stress-free sides; > 0 in tension.

    The lateral stretch solves P_22 = 0 by Newton's method (Ogden 1984, "Non-Linear Elastic Deformations", ch. 4).

    Raises
    ------
    InputError
        A stretch is not positive, or the lateral stretch is not found.

    Examples
    --------
    >>> float(compute_uniaxial_stress(Material("neo-hookean", 3000.0, 0.4999), np.array([1.1]))[0].round())
    273.0
    """
    stretch = np.asarray(stretch, np.float64)
    if not (np.isfinite(stretch) & (stretch > 0.0)).all():
        raise InputError("a stretch is not a positive number: give 1.1 for 10 % tension, 0.9 for compression.")
    evaluate = build_evaluator(tissue, "float64")
    lateral = stretch**-0.5
    sides = np.broadcast_to(np.diag([0.0, 1.0, 1.0]), (len(stretch), 3, 3))
    for _ in range(MAX_STEPS):
        H = np.stack([stretch, lateral, lateral], axis=1)[:, :, None] * np.eye(3) - np.eye(3)
        result = evaluate(H, sides)
        if (np.abs(result.stress[:, 1, 1]) <= TOLERANCE * tissue.lame[0]).all():
            return result.stress[:, 0, 0]
        lateral = np.maximum(lateral - result.stress[:, 1, 1] / result.change[:, 1, 1], 0.5 * lateral)
    low, high = stretch.min(), stretch.max()
    raise InputError(f"no lateral stretch makes the sides of a sample stress-free at stretches {low:g} to {high:g}.")


def compute_shear_stress(tissue: Tissue, shear: np.ndarray) -> np.ndarray:
    """Compute the nominal stress P_12 (n,) [Pa] in simple shear F = I + shear e_1 e_2^T, for shears (n,)."""
    H = np.zeros((len(shear), 3, 3))
    H[:, 0, 1] = shear
    return build_evaluator(tissue, "float64")(H).stress[:, 0, 1]
