"""Ogden's law at equal stretches, against its closed form, and with large exponents."""

import numpy as np
import pytest
from oracle import piola, tissue
from test_sim_law import MU, gradients, relative, rotations

from sim.material import MEASURED_BRAIN, Ogden, Tissue
from sim.named_tissues import MATERIALS
from sim.terms.laws.conformance import build_evaluator

MINUTES = MATERIALS["minutes"].tissue
EVEN = Ogden(((2200.0, -20.0), (300.0, 4.0), (200.0, -2.0)), 54e3)
ODD = Ogden(tuple((c, m + 1e-9) for c, m in EVEN.terms), EVEN.bulk)
LIMITED = Ogden(((2200.0, -20.0), (200.0, 5.0)), 54e3, limit=0.11)


TURN = rotations(1)[0]


PRINCIPAL = {
    "rest": [1.0, 1.0, 1.0],
    "swollen": [1.3, 1.3, 1.3],
    "two equal": [0.8, 1.2, 1.2],
    "nearly two": [0.8, 1.2, 1.2 + 1e-9],
    "closer than single precision": [0.9, 1.1, 1.1 + 1e-7],
    "nearly three": [1.1, 1.1 + 1e-6, 1.1 - 1e-5],
    "apart": [0.5, 1.0, 1.9],
    "one beyond the limit": [0.87, 1.02, 1.04],
    "two nearly equal beyond the limit": [0.85, 0.85 + 1e-9, 1.05],
    "crushed": [0.15, 2.5, 2.5],
}


@pytest.mark.parametrize(
    "of",
    [tissue("ogden"), MINUTES, EVEN, MEASURED_BRAIN, LIMITED],
    ids=["two terms", "minutes", "even", "brain", "limited"],
)
@pytest.mark.parametrize("turn", [np.eye(3), TURN], ids=["on the axes", "turned"])
@pytest.mark.parametrize("stretches", PRINCIPAL.values(), ids=PRINCIPAL)
def test_ogden_stress_at_equal_stretches_is_exact(of: Tissue, turn: np.ndarray, stretches: list[float]) -> None:
    """Against the published stress and its differences, which need no special case; in both precisions."""
    F = np.repeat((turn @ np.diag(stretches) @ turn.T)[None], 40, axis=0)
    D = np.random.default_rng(9).normal(size=F.shape)
    double, single = (build_evaluator(of, precision)(F - np.eye(3), D) for precision in ("float64", "float32"))
    # The fourth-order difference: a step wide enough for the oracle's round-off.
    h = 1e-4 * min(stretches)
    near, far = (
        (piola("ogden", F + step * D, *of.coefficients) - piola("ogden", F - step * D, *of.coefficients)) / (2.0 * step)
        for step in (h, 2.0 * h)
    )
    assert relative(double.change - (4.0 * near - far) / 3.0, double.change).max() < 1e-7
    assert relative(single.change - double.change, double.change).max() < 1e-4
    expected = piola("ogden", F, *of.coefficients)
    scale = max(np.abs(expected).max(), MU)
    assert np.abs(double.stress - expected).max() <= 1e-11 * scale
    assert np.abs(single.stress - double.stress).max() <= 1e-5 * scale


@pytest.mark.parametrize("m", [-19.0, -4.0, 2.0, 8.0])
@pytest.mark.parametrize("stretch", [0.5, 0.9, 1.1, 2.0])
def test_incompressible_ogden_matches_closed_form(m: float, stretch: float) -> None:
    """Uniaxial: sigma_1 - sigma_2 = sum c / m (s^m - s^(-m/2)), for any K."""
    of = Ogden(((1300.0, m), (200.0, 1.5)), 5e4)
    side = stretch**-0.5
    P = build_evaluator(of, "float64")(np.diag([stretch - 1.0, side - 1.0, side - 1.0])[None]).stress[0]
    expected = sum(c / n * (stretch**n - stretch ** (-n / 2.0)) for c, n in of.terms)
    assert stretch * P[0, 0] - side * P[1, 1] == pytest.approx(expected, rel=1e-10)
    assert np.abs(P - np.diag(np.diag(P))).max() == 0.0


def test_large_ogden_exponent_is_accurate_in_single_precision() -> None:
    single, double = (build_evaluator(MINUTES, precision) for precision in ("float32", "float64"))
    for spread, bound in ((1e-5, 1e-5), (1e-3, 1e-5), (0.1, 1e-5), (0.3, 1e-4)):
        H = gradients("ogden", 200, spread).astype(np.float32).astype(np.float64)
        exact = double(H)
        assert relative(exact.stress - piola("ogden", np.eye(3) + H, *MINUTES.coefficients), exact.stress).max() < 1e-7
        assert relative(single(H).stress - exact.stress, exact.stress).max() < bound


def test_ogden_term_without_stiffness_changes_no_stress() -> None:
    """Shorter sums are padded with them where regions share a kernel."""
    H = gradients("ogden")
    D = np.random.default_rng(10).normal(size=H.shape)
    of = tissue("ogden")
    assert isinstance(of, Ogden)
    short = build_evaluator(of, "float64")(H, D)
    filled = build_evaluator(Ogden((*of.terms, (0.0, 1.0)), of.bulk), "float64")(H, D)
    np.testing.assert_array_equal(filled.stress, short.stress)
    np.testing.assert_array_equal(filled.change, short.change)


@pytest.mark.parametrize("spread", [1e-6, 1e-3, 0.1, 0.3])
def test_integer_powers_agree_with_principal_axes(spread: float) -> None:
    """Exponents that are not exactly even take the other path."""
    H = gradients("ogden", 200, spread)
    D = np.random.default_rng(11).normal(size=H.shape)
    powers, axes = (build_evaluator(of, "float64")(H, D) for of in (EVEN, ODD))
    assert relative(powers.stress - axes.stress, axes.stress).max() < 1e-7
    assert relative(powers.change - axes.change, axes.change).max() < 1e-7
    single = build_evaluator(EVEN, "float32")(H.astype(np.float32).astype(np.float64), D)
    assert relative(single.change - powers.change, powers.change).max() < 2e-5
