"""Descriptions of tissue laws, and the conversion of Young's modulus E and Poisson's ratio nu to coefficients."""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from inspect import getattr_static
from typing import TYPE_CHECKING, Protocol

import numpy as np

from .errors import InputError

if TYPE_CHECKING:
    from .terms.laws.law import Law

LAWS = ("linear", "corotational", "neo-hookean", "stable-neo-hookean")
"""Names of the laws with the constants E and nu; the law `Ogden` has other constants."""


HYPERELASTIC = ("neo-hookean", "stable-neo-hookean", "ogden")
"""Names of the laws that support a Prony series: their energy separates shape and volume change at finite strain."""
Pairs = tuple[tuple[float, float], ...]
"""Prony series of pairs (g, tau [s]): deviatoric stress relaxes by a fraction sum g (1 - exp(-t / tau)) in time t."""


@dataclass(frozen=True)
class Material:
    """Tissue law by name, with engineering constants.

    Parameters
    ----------
    law
        Name in `LAWS`.
    young
        Young's modulus at small strain [Pa].
    poisson
        Poisson's ratio at small strain, -1 < nu < 0.5.
    prony
        Prony series of the deviatoric stress, or () without relaxation. With it, E and nu are instantaneous values.

    Raises
    ------
    InputError
        The law is unknown, E <= 0, nu is outside (-1, 0.5), or the series is not physical or not supported by the law.

    Examples
    --------
    >>> from sim import Material
    >>> tissue = Material("neo-hookean", young=3000.0, poisson=0.49)
    >>> print(f"{tissue}; mu {tissue.lame[0]:.0f} Pa")
    neo-hookean, E 3 kPa, nu 0.49; mu 1007 Pa
    """

    law: str
    young: float
    poisson: float
    prony: Pairs = ()

    def __post_init__(self) -> None:
        if self.law == Ogden.law:
            raise InputError("E and nu do not determine Ogden's law: give its terms (c, m) and its bulk modulus.")
        if self.law not in LAWS:
            raise InputError(f"no tissue law is called {self.law!r}: choose one of {', '.join((*LAWS, Ogden.law))}.")
        if not (np.isfinite(self.young) and self.young > 0.0):
            raise InputError(f"Young's modulus is {self.young} Pa: give a positive number.")
        if not -1.0 < self.poisson < 0.5:
            raise InputError(
                f"Poisson's ratio is {self.poisson}: give a number in (-1, 0.5); "
                "for nearly incompressible tissue, 0.49 or 0.4999."
            )
        check_prony(self.prony, self.law)

    def __str__(self) -> str:
        """Return the description for results."""
        return f"{self.law}, E {1e-3 * self.young:g} kPa, nu {self.poisson:g}{', relaxing' if self.prony else ''}"

    @property
    def lame(self) -> tuple[float, float]:
        """Lamé's (mu, lambda) [Pa]: mu = E / (2 (1 + nu)), lambda = E nu / ((1 + nu)(1 - 2 nu))."""
        mu = self.young / (2.0 * (1.0 + self.poisson))
        return mu, self.young * self.poisson / ((1.0 + self.poisson) * (1.0 - 2.0 * self.poisson))

    @property
    def coefficients(self) -> tuple[float, ...]:
        """Coefficients of the law's kernels: Lamé's (mu, lambda) [Pa]."""
        return self.lame

    def coefficients_at(self, mu: float, lam: float) -> tuple[float, ...]:
        """Return the coefficients for other Lamé parameters (mu, lambda) [Pa]."""
        return mu, lam

    @property
    def functions(self) -> Law:
        """Warp functions of the law, imported on first use."""
        return _load_law(self.law)


@dataclass(frozen=True)
class Ogden:
    """Ogden's law: psi = sum_i c_i / m_i^2 (l1^m_i + l2^m_i + l3^m_i - 3) + K/2 (ln J)^2, l = J^(-1/3) lambda.

    The convention is that of FEBio. Papers on brain tissue and Abaqus write 2 mu_i / alpha_i^2 before the bracket:
    then c_i = 2 mu_i and m_i = alpha_i. Ogden 1972 writes mu_i / alpha_i: then c_i = mu_i alpha_i.

    Parameters
    ----------
    terms
        Pairs (c_i [Pa], m_i), one or more.
    bulk
        Bulk modulus K [Pa].
    prony
        Prony series of the deviatoric stress, or () without relaxation. With it, `terms` are instantaneous values.

    Raises
    ------
    InputError
        There are no terms, a number is not finite, an exponent is zero, the shear or bulk stiffness is not positive, or
        the series is not physical.
    """

    law = "ogden"
    terms: tuple[tuple[float, float], ...]
    bulk: float
    prony: Pairs = ()

    def __post_init__(self) -> None:
        if not self.terms:
            raise InputError("Ogden's law has no terms: give at least one pair (c, m).")
        for c, m in self.terms:
            if not (np.isfinite(c) and np.isfinite(m) and m != 0.0):
                raise InputError(f"Ogden's term ({c}, {m}) is invalid: give a finite c [Pa] and a finite, nonzero m.")
        total = sum(c for c, _ in self.terms)
        if total <= 0.0:
            raise InputError(f"Ogden's c sum to {total} Pa, twice the shear modulus: must be positive.")
        if not (np.isfinite(self.bulk) and self.bulk > 0.0):
            raise InputError(f"the bulk modulus is {self.bulk} Pa: give a positive number.")
        check_prony(self.prony, self.law)

    def __str__(self) -> str:
        """Return the description for results."""
        terms = "; ".join(f"{c:g},{m:g}" for c, m in self.terms)
        return f"{self.law} {terms} Pa, K {1e-3 * self.bulk:g} kPa{', relaxing' if self.prony else ''}"

    @property
    def lame(self) -> tuple[float, float]:
        """Lamé's (mu, lambda) [Pa] at small strain: mu = sum c / 2, lambda = K - 2 mu / 3."""
        mu = sum(c for c, _ in self.terms) / 2.0
        return mu, self.bulk - 2.0 * mu / 3.0

    @property
    def coefficients(self) -> tuple[float, ...]:
        """Coefficients of the law's kernels: (K, c_1, m_1, c_2, m_2, ...)."""
        return self.coefficients_at(*self.lame)

    def coefficients_at(self, mu: float, lam: float) -> tuple[float, ...]:
        """Return the coefficients for other Lamé parameters (mu, lambda) [Pa] at small strain."""
        share = mu / self.lame[0]
        return (lam + 2.0 * mu / 3.0, *(number for c, m in self.terms for number in (share * c, m)))

    @property
    def functions(self) -> Law:
        """Warp functions of the law, imported on first use."""
        return _load_law(self.law)


def _load_law(law: str) -> Law:
    return importlib.import_module(f".terms.laws.{law.replace('-', '_')}", __package__).LAW


class Tissue(Protocol):
    """Interface of tissues: `Material`, `Ogden`, or a user-defined law as a frozen dataclass.

    `sim.check_tissue` tests the requirements of the solver.
    """

    @property
    def law(self) -> str:
        """Name of the law; tissues with the same name have the same `functions`."""
        ...

    @property
    def functions(self) -> Law:
        """Warp functions for energy, stress and stress increment."""
        ...

    @property
    def lame(self) -> tuple[float, float]:
        """Lamé's (mu, lambda) [Pa] at small strain."""
        ...

    @property
    def coefficients(self) -> tuple[float, ...]:
        """Coefficients passed to `functions`; their number is the same for all tissues of the law."""
        ...

    def coefficients_at(self, mu: float, lam: float) -> tuple[float, ...]:
        """Return the coefficients for other Lamé parameters (mu, lambda) [Pa] at small strain, including mu = 0.

        The energy must be linear in mu and in lambda, since smoothed elements split shape and volume energy.
        """
        ...

    @property
    def prony(self) -> Pairs:
        """Prony series of the deviatoric stress, or () without relaxation."""
        ...


def check_attributes(tissue: object) -> None:
    """Reject a value that lacks an attribute of `Tissue`.

    Raises
    ------
    InputError
        An attribute is missing; the message lists all missing attributes.
    """
    asked = ("law", "functions", "lame", "coefficients", "coefficients_at", "prony")
    missing = [name for name in asked if getattr_static(tissue, name, None) is None]
    if missing:
        raise InputError(
            f"{type(tissue).__name__} is no tissue: it has no {', '.join(missing)}. "
            "Give a Material, an Ogden, or what `sim.Tissue` asks for."
        )


def build_functions(tissues: Iterable[Tissue]) -> Law:
    """Return the Warp functions of tissues with the same law name.

    Raises
    ------
    InputError
        Two different laws have the same name.
    """
    found = {tissue.functions: tissue.law for tissue in tissues}
    if len(found) > 1:
        raise InputError(f"two tissue laws are called {next(iter(found.values()))!r}: rename one.")
    return next(iter(found))


def check_prony(prony: Pairs, law: str) -> None:
    """Reject a Prony series that is not physical, or not supported by a law.

    Raises
    ------
    InputError
        The law is a small-strain law, some g <= 0 or tau <= 0, or the sum of all g is 1 or more.
    """
    if prony and law not in HYPERELASTIC:
        raise InputError(
            f"the law {law} does not support relaxation, as its energy does not separate shape and volume: "
            f"choose one of {', '.join(HYPERELASTIC)}."
        )
    for g, tau in prony:
        if not (0.0 < g < 1.0 and 0.0 < tau < np.inf):
            raise InputError(f"the Prony pair ({g}, {tau}) is invalid: give 0 < g < 1 and a positive tau [s].")
    total = sum(g for g, _ in prony)
    if total >= 1.0:
        raise InputError(
            f"the Prony series' g sum to {total:g}: must be below 1, so that the long-term stiffness is positive."
        )


def to_tissue_json(tissue: Tissue) -> str:
    """Return the tissue as one line of JSON, which `read_tissue_json` reads."""
    constants = asdict(tissue)  # pyright: ignore[reportArgumentType]
    if not tissue.prony:
        constants.pop("prony", None)  # omitted for backward compatibility
    return json.dumps({"law": tissue.law, **constants})


def read_tissue_json(text: str) -> Tissue:
    """Return the tissue that `to_tissue_json` wrote.

    Raises
    ------
    InputError
        The text has another format, or its constants are invalid.
    """
    try:
        constants = json.loads(text)
        prony = tuple((float(g), float(tau)) for g, tau in constants.pop("prony", ()))
        if constants["law"] == Ogden.law:
            terms = tuple((float(c), float(m)) for c, m in constants["terms"])
            return Ogden(terms, float(constants["bulk"]), prony)
        return Material(**constants, prony=prony)
    except InputError as error:
        raise InputError(f"{text[:200]!r} is no tissue: {error}") from error
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{text[:200]!r} is not a tissue supported by this version: simulate again.") from error


# Ratio lambda / mu of elements that carry shape only, a Poisson's ratio of 0.3.
MAX_LAME_RATIO = 1.5


def get_lame(tissue: Tissue, portion: str) -> tuple[float, float]:
    """Return Lamé's (mu, lambda) [Pa] of the "whole" tissue, or of its "shape" or "volume" portion.

    The two portions add up to the whole. In every law lambda multiplies the square of a measure of volume change.
    """
    mu, lam = tissue.lame
    soft = min(lam, MAX_LAME_RATIO * mu)
    return {"whole": (mu, lam), "shape": (mu, soft), "volume": (0.0, lam - soft)}[portion]


def collect_coefficients(tissues: Sequence[Tissue], portion: str = "whole") -> np.ndarray:
    """Return the coefficients (n, k) of one portion (see `get_lame`) of n tissues with one law.

    Ogden laws with fewer terms are padded with terms (0, 1), which contribute no energy.

    Raises
    ------
    InputError
        Tissues of a law other than Ogden's have different numbers of coefficients.
    """
    rows = [tuple(tissue.coefficients_at(*get_lame(tissue, portion))) for tissue in tissues]
    lengths = sorted({len(row) for row in rows})
    if len(lengths) > 1 and tissues[0].law != Ogden.law:
        raise InputError(
            f"regions of the law {tissues[0].law} have {lengths[0]} and {lengths[-1]} coefficients: must be equal."
        )
    longest = lengths[-1]
    return np.array([row + (0.0, 1.0) * ((longest - len(row)) // 2) for row in rows])


BRAIN = Material("neo-hookean", 3000.0, 0.49)
"""Recommended tissue, used by default in every scene and command. See `elements.RECOMMENDED` for the element."""


@dataclass(frozen=True)
class MaterialSet:
    """Tissue with the time scale for which it is valid and the source of its constants."""

    tissue: Material | Ogden
    time_scale: str
    source: str


MATERIALS = {
    "default": MaterialSet(BRAIN, "seconds", "the same as `seconds`"),
    "seed": MaterialSet(
        Material("neo-hookean", 3330.0, 0.4945),
        "seconds",
        "small-strain equivalent of the two-term Ogden law of Tonutti, Gras, Yang 2017, Artif. Intell. Med. 80:39-47",
    ),
    "seconds": MaterialSet(
        BRAIN,
        "seconds",
        "customary in simulating neurosurgery: Wittek, Hawkins, Miller 2009, Biomech. Model. Mechanobiol. 8:77-84",
    ),
    "undrained": MaterialSet(
        Material("neo-hookean", 3000.0, 0.499),
        "the limit in which no fluid leaves the tissue",
        "`seconds`, nearer to incompressible",
    ),
    "drained": MaterialSet(
        Material("neo-hookean", 2100.0, 0.45),
        "minutes to hours: the limit in which fluid has left the tissue; how fast it leaves is not modelled",
        "E 2.1 kPa, nu 0.45 in brain that consolidates: Miga, Paulsen et al. 1999, IEEE Trans. Med. Imaging 18:866-874",
    ),
    # mu is the shear modulus, with 2 mu / alpha^2 before the bracket, as in the measurements with which the paper
    # compares; if it were FEBio's c_1, the tissue would be half as stiff.
    "minutes": MaterialSet(
        Ogden(((1340.0, -19.0),), 148e3),
        "minutes",
        "mu 670 Pa, alpha -19, K 148 kPa from brain shift between prone and supine in vivo, PMC9748497",
    ),
    # Incompressible in the paper; the bulk modulus is that of an instantaneous Poisson's ratio of 0.49.
    "viscoelastic": MaterialSet(
        Ogden(((2.0 * 842.0, -4.7),), 842.0 * 2.98 / 0.06, ((0.45, 0.5), (0.365, 50.0))),
        "half a second to minutes, as loads say how much time goes by; else at once",
        "mu 842 Pa, alpha -4.7, g 0.45 and 0.365, tau 0.5 and 50 s: Miller, Chinzei 2002, J. Biomech. 35:483-490",
    ),
}
"""Tissues by the names used in commands, each with its valid time scale and the source of its constants.

The stiffness of brain depends on the duration of the load. `default` is the tissue of scenes and of the shipped
models. `viscoelastic` depends on the time of the loads. `seed` is the tissue of the published protocol.
"""
