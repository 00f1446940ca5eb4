"""Prior distributions of the parameters that are not measured during surgery, with their sources."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, TypeGuard

import numpy as np
from scipy.special import ndtri

from sim.errors import InputError
from sim.material import IsotropicTissue, Ogden, Tissue

from .registration import CLINICAL_DEVIATION

if TYPE_CHECKING:
    from surrogate.fitting.tissue import FittedTissue

Law = Literal["uniform", "log-uniform", "normal", "log-normal"]
MESH, REGISTRATION, SEGMENTATION = "mesh", "registration", "segmentation"  # Names of contributors.
TOOL, SKULL = "tool's place", "skull"  # Names of contributors.
MIN_SKULL_PROBABILITY = 0.01  # Smallest total probability of a scene's skull models.
COMBINED = "several together"
"""Name of the interaction: difference between the joint effect and the sum of the single contributions."""


@dataclass(frozen=True)
class ParameterPrior:
    """Prior distribution of an unknown parameter.

    Parameters
    ----------
    name
        Name for printed tables.
    law
        Type of distribution; "normal" has mean 0, "log-normal" median 1.
    range
        Lower and upper limit; for "normal" and "log-normal" both are the standard deviation, of the logarithm.
    meaning
        Meaning of the parameter, with its unit.
    source
        Literature source of the values.
    """

    name: str
    law: Law
    range: tuple[float, float]
    meaning: str
    source: str

    def compute_quantiles(self, probabilities: np.ndarray) -> np.ndarray:
        """Return the quantiles (n,) of the distribution at `probabilities` (n,) in (0, 1)."""
        low, high = self.range
        match self.law:
            case "uniform":
                return low + (high - low) * probabilities
            case "log-uniform":
                return low * (high / low) ** probabilities
            case "log-normal":
                return np.exp(high * ndtri(probabilities))
            case _:
                return high * ndtri(probabilities)


STIFFNESS = ParameterPrior(
    "brain's stiffness", "log-uniform", (0.5, 2.0), "Young's modulus over the scene's",
    "the laws of `sulcus` have 2.0 to 3.3 kPa; persons and methods scatter more: review of Budday, Ovaert, Holzapfel, "
    "Steinmann, Kuhl 2019, Arch. Comput. Methods Eng., 10.1007/s11831-019-09352-w",
)  # fmt: skip
POISSON = ParameterPrior(
    "Poisson's ratio", "uniform", (0.45, 0.4945), "of brain and tumour",
    "0.45 where fluid has left: Miga, Paulsen et al. 1999, IEEE Trans. Med. Imaging 18:866-874; 0.4945 at once: "
    "Tonutti, Gras, Yang 2017, Artif. Intell. Med. 80:39-47",
)  # fmt: skip
RATIO = ParameterPrior(
    "tumour's stiffness", "log-uniform", (0.4, 2.5), "Young's modulus of the tumour over the brain's, over the scene's",
    "22 glioblastomas of 1.32 kPa (healthy tissue: 1.54), five of them stiffer, all of soft and stiff parts: "
    "Streitberger et al. 2014, PLoS ONE 9:e110588",
)  # fmt: skip
MEASURED_STIFFNESS = replace(
    STIFFNESS, law="log-normal", range=(0.5, 0.5),
    source="mu of 0.67 (in vivo, PMC9748497), 0.70 and 1.50 (corona radiata and cortex, Budday et al. 2017, Acta "
    "Biomater. 48:319-340), 0.84 (Miller, Chinzei 2002, J. Biomech. 35:483-490) and 2.4 kPa (operated brains, Chauvet "
    "et al. 2016, Ultraschall Med. 37:584-590): logarithms scatter by 0.50 about that of 1.10 kPa",
)  # fmt: skip
MEASURED_RATIO = replace(
    RATIO, range=(0.4, 4.5),
    source=f"{RATIO.source}; means of four kinds 1.6 to 4.5: Chauvet et al. 2016, Ultraschall Med. 37:584-590",
)  # fmt: skip
EXPONENT = ParameterPrior(
    "brain's law", "log-uniform", (4.7, 25.3), "exponent of Ogden's law, times -1, rounded to an even number",
    "4.7 (swine, Miller, Chinzei 2002, J. Biomech. 35:483-490) to 25.3 (corpus callosum, Budday et al. 2017, Acta "
    "Biomater. 48:319-340)",
)  # fmt: skip
TIP = ParameterPrior(
    TOOL, "normal", (1.06e-3, 1.06e-3), "place of the tool's tip, along each axis [m]",
    "mean error of a tracked probe 1.69 mm: Perwoeg et al. 2018, Int. J. Comput. Assist. Radiol. Surg. 13",
)  # fmt: skip
SKULL_PRIOR = ParameterPrior(
    SKULL, "uniform", (0.0, 1.0), "bonded, sliding or letting go, each as probable",
    "contested: Ji, Roberts, Hartov, Paulsen 2009, Med. Image Anal. 13:659; its bond tears at some kPa, "
    "arXiv 2512.08425",
)  # fmt: skip
MESH_PRIOR = ParameterPrior(
    MESH, "normal", (0.05, 0.05), "share of the tumour's motion, where the skull holds the brain",
    "smoothed elements are 5.2 % off quadratic ones: docs/notes/surrogate_experiments.md",
)  # fmt: skip
SLIDING_MESH_PRIOR = ParameterPrior(
    "mesh of a sliding brain", "normal", (0.12, 0.12), "share of the tumour's motion, where the brain slides",
    "smoothed elements are 8 to 17 % off quadratic ones under tools: docs/notes/uncertainty_experiments.md",
)  # fmt: skip
SINKING_MESH_PRIOR = ParameterPrior(
    "mesh of a sinking brain", "normal", (0.25, 0.25), "share of the tumour's motion, where it slides under weight",
    "smoothed elements are 16 to 22 % off quadratic ones, and these go down on finer meshes: "
    "docs/notes/uncertainty_experiments.md",
)  # fmt: skip
REGISTRATION_PRIOR = ParameterPrior(
    REGISTRATION, "normal", (CLINICAL_DEVIATION, CLINICAL_DEVIATION), "shift of the whole scan, along each axis [m]",
    "2.49 mm in the mean by point pairs in 11 patients: Mongen, Willems 2019, Acta Neurochir. 161",
)  # fmt: skip
SEGMENTATION_PRIOR = ParameterPrior(
    SEGMENTATION, "normal", (1e-3, 1e-3), "how far the tumour's outline is too wide, all round [m]",
    "raters agree with a Dice score of 74 - 85 %, which is 1.3 - 2.3 mm between two of them on 7 ml: Menze et al. "
    "2015, IEEE Trans. Med. Imaging 34:1993-2024",
)  # fmt: skip
MESH_PRIORS = MESH_PRIOR, SLIDING_MESH_PRIOR, SINKING_MESH_PRIOR  # Priors of the mesh error.
OTHER_PRIORS = SKULL_PRIOR, TIP, *MESH_PRIORS, REGISTRATION_PRIOR, SEGMENTATION_PRIOR
PRIORS = STIFFNESS, POISSON, RATIO, *OTHER_PRIORS
"""Priors of tissue without an exponent. The error of a trained model is a further contribution if a model is used."""
MEASURED_PRIORS = MEASURED_STIFFNESS, POISSON, MEASURED_RATIO, *OTHER_PRIORS, EXPONENT
"""Priors of tissue with an exponent, from the spread of measured brain."""


def has_exponent(tissue: Tissue | None) -> TypeGuard[Ogden]:
    """Return True for Ogden's law with one negative exponent, which has a prior."""
    return isinstance(tissue, Ogden) and len(tissue.terms) == 1 and tissue.terms[0][1] < 0.0


def list_priors(tissue: Tissue | None) -> tuple[ParameterPrior, ...]:
    """Return the priors for a brain's tissue."""
    return MEASURED_PRIORS if has_exponent(tissue) else PRIORS


@dataclass(frozen=True)
class PatientSample:
    """Sample of the unknown parameters of tissue, skull, tool and mesh.

    Parameters
    ----------
    stiffness, poisson, ratio
        Young's modulus of the brain relative to the scene; Poisson's ratio; ratio of the Young's moduli of tumour and
        brain, relative to the ratio in the scene.
    skull
        Number in [0, 1) that selects one of the skull conditions that a scene may have.
    tip
        Position error (3,) [m] of the tool: to the right, upwards and inwards.
    mesh
        Mesh error [standard deviations of its prior]; a positive error makes the motion longer.
    exponent
        Exponent of Ogden's law; None: the scene's law.
    """

    stiffness: float
    poisson: float
    ratio: float
    skull: float
    tip: tuple[float, ...]
    mesh: float
    exponent: float | None = None

    def scale_tissue(self, tissue: IsotropicTissue, factor: float = 1.0) -> IsotropicTissue:
        """Return a scene's tissue with the sample's constants; Young's modulus is also multiplied by `factor`."""
        young = factor * self.stiffness * tissue.young
        if self.exponent is not None and has_exponent(tissue):
            tissue = replace(tissue, terms=((tissue.terms[0][0], self.exponent),))
        return tissue.replace_constants(young, self.poisson)


def sample_priors(count: int, seed: int = 0, tissue: Tissue | None = None) -> list[PatientSample]:
    """Draw `count` samples for a brain's tissue by Latin hypercube sampling (McKay, Beckman, Conover 1979)."""
    random = np.random.default_rng(seed)

    def sample() -> np.ndarray:
        return (random.permutation(count) + random.uniform(size=count)) / count

    stiffness, poisson, ratio, *_ = list_priors(tissue)
    columns = [
        prior.compute_quantiles(sample()).tolist() for prior in (stiffness, poisson, ratio, SKULL_PRIOR, TIP, TIP, TIP)
    ]
    columns.append(ndtri(sample()).tolist())
    rows = zip(*columns, strict=True)
    made = [PatientSample(young, nu, ratio, skull, tuple(tip), mesh) for young, nu, ratio, skull, *tip, mesh in rows]
    if not has_exponent(tissue):
        return made
    exponents = -2.0 * np.round(0.5 * EXPONENT.compute_quantiles(sample()))  # Even: fast and exact, see `ogden_powers`.
    return [replace(one, exponent=exponent) for one, exponent in zip(made, exponents.tolist(), strict=True)]


def sample_from_fit(
    fitted: FittedTissue,
    tissue: IsotropicTissue,
    skulls: Sequence[str],
    count: int,
    seed: int = 0,
    tumour_ratio: float = 1.0,
) -> list[PatientSample]:
    """Draw `count` samples with tissue and skull from a fit, and all other parameters from `sample_priors`.

    `tissue` is that of the scene's brain, `tumour_ratio` the stiffness of the scene's tumour relative to the brain, and
    `skulls` the scene's possible skull conditions. Parameters that were not fitted keep their prior.

    Raises
    ------
    InputError
        The fitted skull condition is not possible in the scene.
    """
    if sum(fitted.skulls[name] for name in skulls) < MIN_SKULL_PROBABILITY:
        raise InputError(
            f"the fitted tissue has a skull that this scene cannot have ({' or '.join(skulls)}): choose another scene, "
            "or another tissue by --tissue."
        )
    names, poisson, ratios = fitted.sample(count, seed, tuple(skulls))
    random, made = np.random.default_rng([seed, 3]), []
    moduli = random.choice(fitted.young, count) if len(fitted.young) else None
    for number, one in enumerate(sample_priors(count, seed, tissue)):
        stiffness = one.stiffness if moduli is None else float(moduli[number]) / tissue.young
        skull = (list(skulls).index(names[number]) + 0.5) / len(skulls)
        own = {"poisson": float(poisson[number]), "ratio": float(ratios[number]) / tumour_ratio}
        made.append(replace(one, stiffness=stiffness, skull=skull, **own))
    return made


def sample_rigid_errors(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Sample registration errors (count, 3) [m] and segmentation errors (count,) [m]."""
    random = np.random.default_rng([seed, 1])
    shift = REGISTRATION_PRIOR.range[1] * random.standard_normal((count, 3))
    return shift, SEGMENTATION_PRIOR.range[1] * random.standard_normal(count)


def choose_name(probability: float, choices: Sequence[str]) -> str:
    """Return the name that a number in [0, 1) selects; all names have equal probability."""
    return choices[min(int(probability * len(choices)), len(choices) - 1)]
