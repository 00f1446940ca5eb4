"""Linear elastic body under forces at vertices of the open cortex."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..anatomy import Anatomy


@dataclass(frozen=True, eq=False)
class Body:
    """Linear elastic body.

    Parameters
    ----------
    anatomy
        Mesh with its regions.
    fixed
        Mask (V,) of vertices with zero displacement.
    acting
        Vertex numbers (a,) of the open cortex where forces act.
    lame
        Lame coefficients (mu, lambda) [Pa] by region label.
    """

    anatomy: Anatomy
    fixed: np.ndarray
    acting: np.ndarray
    lame: Mapping[int, tuple[float, float]]
