"""Fitted tissue of a patient, in memory and as a JSON file."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim.effects import SKULLS
from sim.errors import InputError
from sim.runtime.atomic_files import write_atomically
from sim.runtime.outside_files import wrap_errors

FINE_RATIOS = np.geomspace(0.4, 3.2, 33)
"""Ratios of tumour to brain stiffness in the posterior, equally probable a priori."""
FINE_POISSONS = np.linspace(0.45, 0.4945, 13)
"""Poisson's ratios in the posterior, equally probable a priori."""
CLASSES = {"compressible": (0.0, 0.4725), "nearly incompressible": (0.4725, 0.5)}
"""Two classes of Poisson's ratio by their limits, equally probable a priori."""
INTERVAL_PROBABILITIES = (0.025, 0.5, 0.975)  # Probabilities of the reported quantiles: lower end, median, upper end.
MAX_WIDTH_RATIO = 0.85  # Log-width of an interval, relative to the prior range, above which it is uninformative.
MIN_PROBABILITY_SHIFT = 0.15  # Maximum change of probabilities from the prior below which they are uninformative.
FORMAT = "sulcus tissue 1"  # Name and version of the file format.
SUFFIX = ".tissue.json"  # Ending of the file, next to the anatomy.


@dataclass(frozen=True, eq=False)
class FittedTissue:
    """Posterior distribution of a patient's tissue.

    Parameters
    ----------
    anatomy
        Digest of the anatomy.
    frames
        Number of observed frames.
    probability
        Joint probability (skulls, poissons, ratios) of `sim.effects.SKULLS`, `FINE_POISSONS` and `FINE_RATIOS`.
    young
        Equally probable samples (k,) of the brain's Young's modulus [Pa]; empty if no force was measured.
    """

    anatomy: str
    frames: int
    probability: np.ndarray
    young: np.ndarray

    @property
    def ratio(self) -> tuple[float, float, float]:
        """Ratio of tumour to brain stiffness: 2.5, 50 and 97.5 % quantiles."""
        low, middle, high = np.exp(_compute_quantiles(np.log(FINE_RATIOS), self.probability.sum(axis=(0, 1))))
        return float(low), float(middle), float(high)

    @property
    def skulls(self) -> dict[str, float]:
        """Probability of each skull model, by name."""
        return dict(zip(SKULLS, self.probability.sum(axis=(1, 2)).tolist(), strict=True))

    @property
    def classes(self) -> dict[str, float]:
        """Probability of each of the two `CLASSES` of Poisson's ratio, by name."""
        share = self.probability.sum(axis=(0, 2))
        low = float(share @ (CLASSES["compressible"][1] > FINE_POISSONS))
        return dict(zip(CLASSES, (low, 1.0 - low), strict=True))

    @property
    def poisson(self) -> tuple[float, float, float]:
        """Poisson's ratio: 2.5, 50 and 97.5 % quantiles."""
        low, middle, high = _compute_quantiles(FINE_POISSONS, self.probability.sum(axis=(0, 2)))
        return float(low), float(middle), float(high)

    @property
    def stiffness(self) -> tuple[float, float, float] | None:
        """Young's modulus of the brain at small strain [Pa]: quantiles as `ratio`; None if no force was measured."""
        if not len(self.young):
            return None
        low, middle, high = np.quantile(self.young, INTERVAL_PROBABILITIES)
        return float(low), float(middle), float(high)

    @property
    def not_known(self) -> list[str]:
        """Names of the quantities that the frames do not determine."""
        low, _, high = self.ratio
        found = (
            []
            if np.log(high / low) < MAX_WIDTH_RATIO * np.log(FINE_RATIOS[-1] / FINE_RATIOS[0])
            else ["the tumour's stiffness"]
        )
        for name, share in (("the skull", self.skulls), ("Poisson's ratio", self.classes)):
            if max(abs(each - 1.0 / len(share)) for each in share.values()) < MIN_PROBABILITY_SHIFT:
                found.append(name)
        return [*found, *(["Young's modulus"] if self.stiffness is None else [])]

    def sample(
        self, count: int, seed: int = 0, skulls: tuple[str, ...] = tuple(SKULLS)
    ) -> tuple[list[str], np.ndarray, np.ndarray]:
        """Sample `count` triples of skull, Poisson's ratio and stiffness ratio; `skulls` are the allowed skulls."""
        random = np.random.default_rng([seed, 2])
        allowed = np.array([name in skulls for name in SKULLS])
        share = (self.probability * allowed[:, None, None]).ravel()
        at = np.cumsum(share / share.sum())
        where = (random.permutation(count) + random.uniform(size=count)) / count
        skull, poisson, ratio = np.unravel_index(
            np.searchsorted(at, where).clip(max=at.size - 1), self.probability.shape
        )
        return [list(SKULLS)[each] for each in skull], FINE_POISSONS[poisson], FINE_RATIOS[ratio]

    drawn = sample  # Former names, for one release.


def _compute_quantiles(values: np.ndarray, probabilities: np.ndarray) -> np.ndarray:
    return np.interp(INTERVAL_PROBABILITIES, np.cumsum(probabilities) - 0.5 * probabilities, values)


def to_tissue_path(anatomy: str | Path) -> Path:
    """Return the path of an anatomy's fitted tissue: MESH.tissue.json, next to MESH.vtu."""
    return Path(anatomy).with_suffix(SUFFIX)


def save_tissue(path: str | Path, tissue: FittedTissue) -> None:
    """Write fitted tissue to a JSON file, atomically."""
    stored = {
        "format": FORMAT, "anatomy": tissue.anatomy, "frames": tissue.frames, "skull": list(SKULLS),
        "poisson": FINE_POISSONS.tolist(), "ratio": FINE_RATIOS.tolist(),
        "probability": tissue.probability.tolist(), "young": tissue.young.tolist(),
    }  # fmt: skip
    with write_atomically(path, ".json") as unfinished:
        unfinished.write_text(json.dumps(stored) + "\n")


def load_tissue(path: str | Path, digest: str) -> FittedTissue:
    """Read fitted tissue from a file, for the anatomy with the given `digest`.

    Raises
    ------
    InputError
        The file is missing, of another version, damaged, or for another anatomy.
    """
    with wrap_errors(path, "fitted tissue", "Make it again by `sulcus fit`."):
        stored = json.loads(Path(path).read_text(encoding="utf-8-sig"))
        if stored["format"] != FORMAT or stored["skull"] != list(SKULLS):
            raise InputError(f"{path}: is not a fitted tissue of this version: make it again by `sulcus fit`.")
        if stored["anatomy"] != digest:
            raise InputError(f"{path}: was fitted to another anatomy: give that one, or fit tissue to this one.")
        probability, young = (np.array(stored[name], float) for name in ("probability", "young"))
        fits = probability.shape == (len(SKULLS), len(FINE_POISSONS), len(FINE_RATIOS)) and young.ndim == 1
        if not fits or not (probability >= 0.0).all() or abs(probability.sum() - 1.0) > 1e-6 or not (young > 0.0).all():
            raise InputError(f"{path}: holds no probabilities: make it again by `sulcus fit`.")
        return FittedTissue(stored["anatomy"], int(stored["frames"]), probability, young)
