"""Every tissue law: its formulas are each other's derivatives, meet Hooke's law, and do not cancel."""

import numpy as np
import pytest
from oracle import EVERY_LAW, energy_density, nearest_rotation, piola, tissue

from sim.material import MATERIALS, Ogden, Tissue
from sim.terms.laws.conformance import Evaluator, build_evaluator

POSITIVE = ("neo-hookean", "ogden")
"""Laws that are infinite where J <= 0."""
MU = tissue("linear").lame[0]


@pytest.fixture(scope="module", params=EVERY_LAW)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def double(name: str) -> Evaluator:
    return build_evaluator(tissue(name), "float64")


@pytest.fixture(scope="module")
def single(name: str) -> Evaluator:
    return build_evaluator(tissue(name), "float32")


def gradients(name: str, count: int = 60, spread: float = 0.6) -> np.ndarray:
    """Random displacement gradients (n, 3, 3), large; inverted ones too where the law has them."""
    H = np.random.default_rng(3).normal(0.0, spread, (3 * count, 3, 3))
    J = np.linalg.det(np.eye(3) + H)
    return H[J > 0.1][:count] if name in POSITIVE else H[np.abs(J) > 0.02][:count]


def rotations(count: int) -> np.ndarray:
    Q, _ = np.linalg.qr(np.random.default_rng(4).normal(size=(count, 3, 3)))
    return Q * np.linalg.det(Q)[:, None, None]


def relative(error: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Error (n,) in the Frobenius norm, relative to `exact` (n, 3, 3)."""
    return np.linalg.norm(error, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))


def test_large_strains_include_inverted_elements(name: str) -> None:
    J = np.linalg.det(np.eye(3) + gradients(name))
    assert J.max() > 2.0
    assert (J.min() < -0.2) == (name not in POSITIVE)


def test_energy_is_the_published_formula(name: str, double: Evaluator) -> None:
    H = gradients(name)
    expected = energy_density(name, np.eye(3) + H, *tissue(name).coefficients)
    np.testing.assert_allclose(double(H).energy, expected, rtol=1e-11, atol=1e-9)


def test_stress_is_the_published_formula(name: str, double: Evaluator) -> None:
    H = gradients(name)
    expected = piola(name, np.eye(3) + H, *tissue(name).coefficients)
    assert relative(double(H).stress - expected, expected).max() < 1e-11


def test_stress_is_the_gradient_of_the_energy(name: str, double: Evaluator) -> None:
    H, h = gradients(name), 1e-5
    numeric = np.zeros_like(H)
    for i in range(3):
        for j in range(3):
            step = np.zeros((3, 3))
            step[i, j] = h
            numeric[:, i, j] = (double(H + step).energy - double(H - step).energy) / (2.0 * h)
    assert relative(numeric - double(H).stress, double(H).stress).max() < 1e-6


def test_stress_change_is_the_gradient_of_the_stress(name: str, double: Evaluator) -> None:
    H, h = gradients(name), 1e-6
    D = np.random.default_rng(5).normal(size=H.shape)
    numeric = (double(H + h * D).stress - double(H - h * D).stress) / (2.0 * h)
    exact = double(H, D).change
    assert relative(numeric - exact, exact).max() < 1e-6


def test_curvature_is_symmetric(name: str, double: Evaluator) -> None:
    H = gradients(name)
    D, E = np.random.default_rng(6).normal(size=(2, *H.shape))
    one = np.einsum("nij,nij->n", double(H, D).change, E)
    other = np.einsum("nij,nij->n", double(H, E).change, D)
    np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-7)


@pytest.mark.parametrize(("young", "poisson"), [(3000.0, 0.45), (1.0e4, 0.0), (500.0, 0.4945), (3000.0, -0.3)])
def test_small_strain_is_hookes_law_with_young_and_poisson(
    name: str, double: Evaluator, young: float, poisson: float
) -> None:
    """Uniaxial stress of 1e-6 E stretches by 1e-6 and contracts by nu 1e-6; a shear strain gives E / (2 (1 + nu))."""
    stretch = 1e-6 * np.diag([1.0, -poisson, -poisson])
    shear = 1e-6 * (np.eye(3)[[1]].T @ np.eye(3)[[0]] + np.eye(3)[[0]].T @ np.eye(3)[[1]])
    stress = double(np.stack([stretch, shear]), of=tissue(name, young, poisson)).stress
    np.testing.assert_allclose(stress[0], 1e-6 * young * np.diag([1.0, 0.0, 0.0]), atol=1e-10 * young)
    np.testing.assert_allclose(stress[1], shear * young / (1.0 + poisson), atol=1e-10 * young)


def test_rotations_cost_nothing_and_turn_the_stress(name: str, double: Evaluator) -> None:
    if name == "linear":
        pytest.skip("small strain is not invariant, and says so")
    H = gradients(name)
    Q = rotations(len(H))
    turned = double(Q @ (np.eye(3) + H) - np.eye(3))
    still = double(H)
    np.testing.assert_allclose(turned.energy, still.energy, rtol=1e-10)
    assert relative(turned.stress - Q @ still.stress, still.stress).max() < 1e-9
    assert np.abs(double(Q - np.eye(3)).stress).max() < 1e-9 * MU


def test_linear_law_sees_rotations(double: Evaluator, name: str) -> None:
    if name == "linear":
        assert double(rotations(3) - np.eye(3)).energy.min() > 0.01 * MU


def test_isotropic(name: str, double: Evaluator) -> None:
    H = gradients(name)
    Q = rotations(len(H))
    turned = double(Q @ H @ Q.transpose(0, 2, 1))
    np.testing.assert_allclose(turned.energy, double(H).energy, rtol=1e-10)


def test_rest_is_exactly_free_of_stress(name: str, double: Evaluator, single: Evaluator) -> None:
    for evaluate in (double, single):
        at_rest = evaluate(np.zeros((1, 3, 3)))
        assert not at_rest.stress.any()
        assert not at_rest.energy.any()


@pytest.mark.parametrize("size", [1e-5, 1e-4, 1e-3])
def test_single_precision_does_not_cancel_at_small_strain(
    name: str, single: Evaluator, double: Evaluator, size: float
) -> None:
    H = np.random.default_rng(7).normal(0.0, size, (200, 3, 3)).astype(np.float32).astype(np.float64)
    exact = double(H)
    assert relative(single(H).stress - exact.stress, exact.stress).max() < 1e-5
    np.testing.assert_allclose(single(H).energy, exact.energy, rtol=1e-5)


def test_single_precision_at_large_strain(name: str, single: Evaluator, double: Evaluator) -> None:
    H = gradients(name, spread=0.3).astype(np.float32).astype(np.float64)
    D = np.random.default_rng(8).normal(size=H.shape)
    exact = double(H, D)
    assert relative(single(H).stress - exact.stress, exact.stress).max() < 1e-4
    assert np.median(relative(single(H, D).change - exact.change, exact.change)) < 1e-5


@pytest.mark.parametrize("law", POSITIVE)
def test_laws_with_a_logarithm_are_infinite_where_inverted(law: str) -> None:
    evaluate = build_evaluator(tissue(law), "float64")
    assert np.isposinf(evaluate(np.diag([-2.0, 0.0, 0.0])[None]).energy).all()
    assert np.isposinf(evaluate(np.diag([-1.0, 0.0, 0.0])[None]).energy).all()


def test_corotational_rotation_is_proper_and_nearest() -> None:
    """With lambda = 0, F - P / (2 mu) is the rotation that the law used."""
    evaluate = build_evaluator(tissue("corotational", poisson=0.0), "float64")
    F = np.eye(3) + gradients("corotational")
    R = F - evaluate(F - np.eye(3)).stress / (2.0 * evaluate.of.lame[0])
    assert (np.linalg.det(F) < 0.0).any()
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-11)
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-11)
    np.testing.assert_allclose(R, nearest_rotation(F), atol=1e-9)


MINUTES = MATERIALS["minutes"].tissue
TURN = rotations(1)[0]
PRINCIPAL = {
    "rest": [1.0, 1.0, 1.0],
    "swollen": [1.3, 1.3, 1.3],
    "two equal": [0.8, 1.2, 1.2],
    "nearly two": [0.8, 1.2, 1.2 + 1e-9],
    "closer than single precision": [0.9, 1.1, 1.1 + 1e-7],
    "nearly three": [1.1, 1.1 + 1e-6, 1.1 - 1e-5],
    "apart": [0.5, 1.0, 1.9],
    "crushed": [0.15, 2.5, 2.5],
}


@pytest.mark.parametrize("of", [tissue("ogden"), MINUTES], ids=["two terms", "minutes"])
@pytest.mark.parametrize("turn", [np.eye(3), TURN], ids=["on the axes", "turned"])
@pytest.mark.parametrize("stretches", PRINCIPAL.values(), ids=PRINCIPAL)
def test_equal_stretches_are_no_special_case(of: Tissue, turn: np.ndarray, stretches: list[float]) -> None:
    """Against the published stress and its differences, which take no notice of what is equal; in both precisions."""
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
    """Uniaxial: sigma_1 - sigma_2 = sum c / m (s^m - s^(-m/2)), whatever K."""
    of = Ogden(((1300.0, m), (200.0, 1.5)), 5e4)
    side = stretch**-0.5
    P = build_evaluator(of, "float64")(np.diag([stretch - 1.0, side - 1.0, side - 1.0])[None]).stress[0]
    expected = sum(c / n * (stretch**n - stretch ** (-n / 2.0)) for c, n in of.terms)
    assert stretch * P[0, 0] - side * P[1, 1] == pytest.approx(expected, rel=1e-10)
    assert np.abs(P - np.diag(np.diag(P))).max() == 0.0


def test_exponent_of_nineteen_in_single_precision() -> None:
    single, double = (build_evaluator(MINUTES, precision) for precision in ("float32", "float64"))
    for spread, bound in ((1e-5, 1e-5), (1e-3, 1e-5), (0.1, 1e-5), (0.3, 1e-4)):
        H = gradients("ogden", 200, spread).astype(np.float32).astype(np.float64)
        exact = double(H)
        assert relative(exact.stress - piola("ogden", np.eye(3) + H, *MINUTES.coefficients), exact.stress).max() < 1e-7
        assert relative(single(H).stress - exact.stress, exact.stress).max() < bound


def test_a_term_of_no_stiffness_adds_nothing() -> None:
    """Shorter sums are filled up with them where regions share a kernel."""
    H = gradients("ogden")
    D = np.random.default_rng(10).normal(size=H.shape)
    of = tissue("ogden")
    assert isinstance(of, Ogden)
    short = build_evaluator(of, "float64")(H, D)
    filled = build_evaluator(Ogden((*of.terms, (0.0, 1.0)), of.bulk), "float64")(H, D)
    np.testing.assert_array_equal(filled.stress, short.stress)
    np.testing.assert_array_equal(filled.change, short.change)
