"""Diagnostic fields of a `Deformation`: leak, bond and stretch, and the outcomes that follow from these fields."""

from collections.abc import Iterable

import numpy as np
import warp as wp

from ..anatomy import Anatomy
from ..deformation import Outcome
from ..discretisation.space import Discretisation
from ..effects import Bonded, Effect
from ..runtime.device import Device
from .bond_traction import BondTraction
from .skull_leak import SkullLeak
from .stretch import TissueStretch


class Diagnostics:
    """Diagnostics of deformations of an anatomy under given effects."""

    def __init__(
        self, anatomy: Anatomy, space: Discretisation, effects: Iterable[Effect], device: Device, has_strain_limit: bool
    ):
        self._leak, self._stretch = SkullLeak(anatomy, space, device), TissueStretch(space, device)
        self._limit_strain = has_strain_limit
        bonded = (effect for effect in effects if isinstance(effect, Bonded))
        self._bond = next((BondTraction(effect, anatomy, space, device) for effect in bonded), None)

    @property
    def needs_forces(self) -> bool:
        """True if `compute_fields` needs the forces at fixed nodes."""
        return self._bond is not None

    def compute_fields(self, u: wp.array, force: wp.array | None) -> dict[str, np.ndarray]:
        """Return `leaked`, `bond`, `stretch`, `strained` by name, at u (3N, B) [m] with internal forces (3N, B) [N]."""
        bond = self._bond.compute_max_ratio(force) if self._bond and force is not None else np.array(np.nan)
        return {"leaked": self._leak.compute_fraction(u), "bond": bond, **self.compute_strains(u)}

    def compute_strains(self, u: wp.array) -> dict[str, np.ndarray]:
        """Return `stretch` and `strained`, by name, at u (3N, B) [m]."""
        return self._stretch.measure_stretch(u)

    def mark_outcomes(self, outcome: np.ndarray, inverted: np.ndarray, strained: np.ndarray) -> np.ndarray:
        """Return the outcomes (B,); if strains are limited, equilibria with inverted or overstrained tissue are marked.

        `inverted` (B,) are numbers of tetrahedra, and `strained` (B,) are volumes [m^3], as in `Deformation`.
        """
        good = np.array([one.good and self._limit_strain for one in outcome], bool)
        out = outcome.copy()
        out[good & self._stretch.is_beyond_range(strained)] = Outcome.OVERSTRAINED
        out[good & (inverted > 0)] = Outcome.INVERTED
        return out
