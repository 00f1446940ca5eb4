"""Tissue descriptions: constants at small strain, rejected values, and named tissues."""

import numpy as np
import pytest

from sim.errors import InputError
from sim.material import (
    LAWS,
    MEASURED_BRAIN,
    Material,
    Ogden,
    Tissue,
    collect_coefficients,
    read_tissue_json,
    to_tissue_json,
)
from sim.named_tissues import MATERIALS


def test_lame_constants_agree_with_young_and_poisson() -> None:
    mu, lam = Material("linear", 3000.0, 0.45).lame
    assert mu * (3.0 * lam + 2.0 * mu) / (lam + mu) == pytest.approx(3000.0)
    assert lam / (2.0 * (lam + mu)) == pytest.approx(0.45)


def test_ogden_constants_give_small_strain_moduli() -> None:
    """Twice the shear modulus is the sum of c, for any exponents."""
    mu, lam = Ogden(((1000.0, -19.0), (-200.0, 4.0), (600.0, 0.5)), 5e4).lame
    assert mu == pytest.approx(700.0)
    assert lam + 2.0 * mu / 3.0 == pytest.approx(5e4)


def test_coefficients_of_tissues_are_padded_to_equal_length() -> None:
    tissues = Ogden(((1.0, 2.0),), 9.0), Ogden(((3.0, 4.0), (5.0, 6.0), (7.0, 8.0)), 10.0)
    rows = collect_coefficients(tissues)
    np.testing.assert_array_equal(rows, [[9, 1e3, 1, 2, 0, 1, 0, 1], [10, 1e3, 3, 4, 5, 6, 7, 8]])
    np.testing.assert_array_equal(
        collect_coefficients([Material(law, 3000.0, 0.3) for law in LAWS]),
        [Material(LAWS[0], 3000.0, 0.3).lame] * len(LAWS),
    )


@pytest.mark.parametrize(
    ("terms", "bulk", "words"),
    [
        ((), 1e4, "no terms"),
        (((1000.0, 0.0),), 1e4, "nonzero m"),
        (((np.nan, 2.0),), 1e4, "finite"),
        (((1000.0, np.inf),), 1e4, "finite"),
        (((1000.0, 2.0), (-1000.0, 3.0)), 1e4, "sum to 0.0 Pa"),
        (((-1000.0, 2.0),), 1e4, "positive"),
        (((1000.0, 2.0),), 0.0, "bulk modulus is 0.0"),
        (((1000.0, 2.0),), -5.0, "bulk modulus is -5.0"),
        (((1000.0, 2.0),), np.nan, "bulk modulus is nan"),
        (((1000.0, 2.0),), np.inf, "bulk modulus is inf"),
    ],
)
def test_invalid_ogden_constants_are_rejected(terms: tuple, bulk: float, words: str) -> None:
    with pytest.raises(InputError, match=words):
        Ogden(terms, bulk)


@pytest.mark.parametrize(
    ("law", "young", "poisson", "words"),
    [
        ("jelly", 3000.0, 0.3, "no tissue law is called 'jelly': choose one of .*ogden"),
        ("ogden", 3000.0, 0.3, "do not determine Ogden's law"),
        ("linear", 0.0, 0.3, "Young's modulus is 0.0"),
        ("linear", np.inf, 0.3, "Young's modulus is inf"),
        ("linear", 3000.0, 0.5, "Poisson's ratio is 0.5"),
        ("linear", 3000.0, -1.0, "Poisson's ratio is -1.0"),
        ("linear", 3000.0, np.nan, "Poisson's ratio is nan"),
    ],
)
def test_invalid_engineering_constants_are_rejected(law: str, young: float, poisson: float, words: str) -> None:
    with pytest.raises(InputError, match=words):
        Material(law, young, poisson)


@pytest.mark.parametrize(
    "tissue", [*(known.tissue for known in MATERIALS.values()), Ogden(((0.1, -19.0), (1e3 / 3.0, 2.5)), 7.0)]
)
def test_tissue_json_round_trip_is_exact(tissue: Tissue) -> None:
    assert read_tissue_json(to_tissue_json(tissue)) == tissue


PLAIN = (Material("linear", 3000.0, 0.45), Ogden(((1684.0, -4.7),), 4e4))
SERIES = ((0.45, 0.5), (0.365, 50.0))


@pytest.mark.parametrize(
    "tissue",
    [Material("neo-hookean", 3000.0, 0.45, SERIES), Ogden(((1684.0, -4.7),), 4e4, SERIES), *PLAIN, MEASURED_BRAIN],
)
def test_tissue_json_round_trip_keeps_prony_series(tissue: Tissue) -> None:
    line = to_tissue_json(tissue)
    assert read_tissue_json(line) == tissue
    assert ("prony" in line) == bool(tissue.prony)


@pytest.mark.parametrize(
    ("law", "series", "words"),
    [
        ("linear", SERIES, "linear does not support relaxation.*choose one of neo-hookean, stable-neo-hookean, ogden"),
        ("corotational", SERIES, "corotational does not support relaxation"),
        ("neo-hookean", ((0.0, 1.0),), r"pair \(0.0, 1.0\) is invalid: give 0 < g < 1"),
        ("neo-hookean", ((0.5, 0.0),), "positive tau"),
        ("neo-hookean", ((0.5, np.inf),), "positive tau"),
        ("neo-hookean", ((np.nan, 1.0),), "0 < g < 1"),
        ("neo-hookean", ((0.5, 1.0), (0.5, 2.0)), "g sum to 1: must be below 1"),
    ],
)
def test_invalid_prony_series_are_rejected(law: str, series: tuple, words: str) -> None:
    with pytest.raises(InputError, match=words):
        Material(law, 3000.0, 0.45, series)
    if law == "neo-hookean":
        with pytest.raises(InputError, match=words):
            Ogden(((1000.0, 2.0),), 1e4, series)


def test_relaxing_tissue_keeps_a_fifth_of_stiffness() -> None:
    named = MATERIALS["viscoelastic"].tissue
    assert named.lame[0] == pytest.approx(842.0)
    assert named.lame[1] / (2.0 * (named.lame[0] + named.lame[1])) == pytest.approx(0.49)
    assert 1.0 - sum(g for g, _ in named.prony) == pytest.approx(0.185)


@pytest.mark.parametrize("tissue", [Material("neo-hookean", 3000.0, 0.45), Ogden(((900.0, -4.0), (300.0, 3.0)), 4e4)])
def test_replaced_constants_are_those_of_the_tissue(tissue: Material | Ogden) -> None:
    found = tissue.replace_constants(5000.0, 0.4)
    np.testing.assert_allclose(found.lame, Material("linear", 5000.0, 0.4).lame, rtol=1e-12)
    assert (found.young, found.poisson, found.law) == (5000.0, 0.4, tissue.law)
    assert found.replace_constants(tissue.young, tissue.poisson).coefficients == pytest.approx(tissue.coefficients)


@pytest.mark.parametrize("limit", [0.0, -0.1, 1.0, np.nan])
def test_limit_of_ogden_outside_its_range_is_rejected(limit: float) -> None:
    with pytest.raises(InputError, match="logarithmic strain between 0 and 1"):
        Ogden(((2200.0, -20.0),), 5e4, limit=limit)
