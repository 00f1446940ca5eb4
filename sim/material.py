"""Descriptions of tissue laws, and the conversion of Young's modulus E and Poisson's ratio nu to coefficients."""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
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
NO_LIMIT = 1e3  # Limit of an Ogden law without one; no logarithmic strain reaches it.
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

    def replace_constants(self, young: float | None = None, poisson: float | None = None) -> Material:
        """Return the tissue with another Young's modulus [Pa] or Poisson's ratio; None keeps the present one."""
        return replace(
            self, young=self.young if young is None else young, poisson=self.poisson if poisson is None else poisson
        )

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
    limit
        |ln l| above which growing exponentials continue as Taylor polynomials of second degree; None: nowhere. A large
        exponent that was fitted to small strains is far too stiff beyond them.

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
    limit: float | None = None

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
        if self.limit is not None and not 0.0 < self.limit < 1.0:
            raise InputError(f"the limit of Ogden's law is {self.limit}: give a logarithmic strain between 0 and 1.")
        check_prony(self.prony, self.law)

    def __str__(self) -> str:
        """Return the description for results."""
        terms = "; ".join(f"{c:g},{m:g}" for c, m in self.terms)
        limit = "" if self.limit is None else f", polynomial from strain {self.limit:g}"
        return f"{self.law} {terms} Pa, K {1e-3 * self.bulk:g} kPa{limit}{', relaxing' if self.prony else ''}"

    @property
    def lame(self) -> tuple[float, float]:
        """Lamé's (mu, lambda) [Pa] at small strain: mu = sum c / 2, lambda = K - 2 mu / 3."""
        mu = sum(c for c, _ in self.terms) / 2.0
        return mu, self.bulk - 2.0 * mu / 3.0

    @property
    def young(self) -> float:
        """Young's modulus at small strain [Pa]."""
        mu, lam = self.lame
        return round(mu * (3.0 * lam + 2.0 * mu) / (lam + mu), 9)

    @property
    def poisson(self) -> float:
        """Poisson's ratio at small strain."""
        mu, lam = self.lame
        return round(lam / (2.0 * (lam + mu)), 12)

    def replace_constants(self, young: float | None = None, poisson: float | None = None) -> Ogden:
        """Return the tissue with another Young's modulus [Pa] or Poisson's ratio at small strain, and its exponents."""
        if young is None and poisson is None:
            return self
        times = 1.0 if young is None else young / self.young
        mu, lam = (times * one for one in self.lame)
        if poisson is not None:
            mu, lam = Material("linear", times * self.young, poisson).lame
        bulk, _, *terms = self.coefficients_at(mu, lam)
        return replace(self, terms=tuple(zip(terms[::2], terms[1::2], strict=True)), bulk=bulk)

    @property
    def coefficients(self) -> tuple[float, ...]:
        """Coefficients of the law's kernels: (K, limit, c_1, m_1, c_2, m_2, ...)."""
        return self.coefficients_at(*self.lame)

    def coefficients_at(self, mu: float, lam: float) -> tuple[float, ...]:
        """Return the coefficients for other Lamé parameters (mu, lambda) [Pa] at small strain."""
        share = mu / self.lame[0]
        limit = NO_LIMIT if self.limit is None else self.limit
        return (lam + 2.0 * mu / 3.0, limit, *(number for c, m in self.terms for number in (share * c, m)))

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
    for name, usual in (("prony", ()), ("limit", None)):  # omitted for backward compatibility
        if constants.get(name) == usual:
            constants.pop(name, None)
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
            limit = constants.get("limit")
            return Ogden(terms, float(constants["bulk"]), prony, None if limit is None else float(limit))
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


IsotropicTissue = Material | Ogden
"""Tissue with Young's modulus and Poisson's ratio at small strain."""
BRAIN = Material("neo-hookean", 3000.0, 0.49)
"""Recommended tissue, used by default in every scene and command. See `elements.RECOMMENDED` for the element."""
MEASURED_BRAIN = Ogden(((2200.0, -20.0),), 2200.0 * 1.49 / 0.06, limit=0.11)
"""Human brain ex vivo, the mean of grey and white matter: see `named_tissues.MATERIALS`."""


def build_law(law: str, young: float, poisson: float) -> IsotropicTissue:
    """Return tissue of a law, with constants at small strain; Ogden's has the exponent of `MEASURED_BRAIN`.

    Raises
    ------
    InputError
        See `Material`.
    """
    return MEASURED_BRAIN.replace_constants(young, poisson) if law == Ogden.law else Material(law, young, poisson)
