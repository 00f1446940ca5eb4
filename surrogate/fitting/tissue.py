"""What is known of a patient's tissue after it was seen: probabilities of its stiffness, compressibility and skull."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.effects import SKULLS

FINE_RATIOS = np.geomspace(0.4, 3.2, 33)
"""Stiffness of the tumour over the brain's, equally probable before anything is seen."""
FINE_POISSONS = np.linspace(0.45, 0.4945, 13)
"""Poisson's ratios, equally probable before."""
CLASSES = {"compressible": (0.0, 0.4725), "nearly incompressible": (0.4725, 0.5)}
"""Poisson's ratios in two classes, as probable before."""
INTERVAL = (0.025, 0.5, 0.975)
# An interval that is wider than this share of the prior's says nothing new; so do probabilities nearer to the prior's.
AS_WIDE, AS_PROBABLE = 0.85, 0.15


@dataclass(frozen=True, eq=False)
class FittedTissue:
    """Probabilities of a patient's tissue.

    Parameters
    ----------
    anatomy
        Digest of the body.
    frames
        How many it was fitted to.
    probability
        (skulls, poissons, ratios), which sum to 1: of `sim.effects.SKULLS`, `FINE_POISSONS` and `FINE_RATIOS`.
    young
        (k,) Young's moduli of the brain [Pa], as probable each; empty: no force was read, and nothing is known of it.
    """

    anatomy: str
    frames: int
    probability: np.ndarray
    young: np.ndarray

    @property
    def ratio(self) -> tuple[float, float, float]:
        """Tumour's stiffness over the brain's: 2.5 %, 50 % and 97.5 % of the probability lie below."""
        low, middle, high = np.exp(_quantiles(np.log(FINE_RATIOS), self.probability.sum(axis=(0, 1))))
        return float(low), float(middle), float(high)

    @property
    def skulls(self) -> dict[str, float]:
        """Probability of each skull."""
        return dict(zip(SKULLS, self.probability.sum(axis=(1, 2)).tolist(), strict=True))

    @property
    def classes(self) -> dict[str, float]:
        """Probability of each of `CLASSES` of Poisson's ratio."""
        share = self.probability.sum(axis=(0, 2))
        low = float(share @ (CLASSES["compressible"][1] > FINE_POISSONS))
        return dict(zip(CLASSES, (low, 1.0 - low), strict=True))

    @property
    def poisson(self) -> tuple[float, float, float]:
        """Poisson's ratio, as `ratio`."""
        low, middle, high = _quantiles(FINE_POISSONS, self.probability.sum(axis=(0, 2)))
        return float(low), float(middle), float(high)

    @property
    def stiffness(self) -> tuple[float, float, float] | None:
        """Young's modulus of the brain at small strain [Pa], as `ratio`; None: no force was read."""
        if not len(self.young):
            return None
        low, middle, high = np.quantile(self.young, INTERVAL)
        return float(low), float(middle), float(high)

    @property
    def not_known(self) -> list[str]:
        """What the frames say nothing of."""
        low, _, high = self.ratio
        found = (
            []
            if np.log(high / low) < AS_WIDE * np.log(FINE_RATIOS[-1] / FINE_RATIOS[0])
            else ["the tumour's stiffness"]
        )
        for name, share in (("the skull", self.skulls), ("Poisson's ratio", self.classes)):
            if max(abs(each - 1.0 / len(share)) for each in share.values()) < AS_PROBABLE:
                found.append(name)
        return [*found, *(["Young's modulus"] if self.stiffness is None else [])]

    def drawn(
        self, count: int, seed: int = 0, skulls: tuple[str, ...] = tuple(SKULLS)
    ) -> tuple[list[str], np.ndarray, np.ndarray]:
        """So many skulls, Poisson's ratios and ratios, which go together, where only some skulls may be."""
        random = np.random.default_rng([seed, 2])
        allowed = np.array([name in skulls for name in SKULLS])
        share = (self.probability * allowed[:, None, None]).ravel()
        at = np.cumsum(share / share.sum())
        where = (random.permutation(count) + random.uniform(size=count)) / count
        skull, poisson, ratio = np.unravel_index(
            np.searchsorted(at, where).clip(max=at.size - 1), self.probability.shape
        )
        return [list(SKULLS)[each] for each in skull], FINE_POISSONS[poisson], FINE_RATIOS[ratio]


def _quantiles(values: np.ndarray, share: np.ndarray) -> np.ndarray:
    return np.interp(INTERVAL, np.cumsum(share) - 0.5 * share, values)
