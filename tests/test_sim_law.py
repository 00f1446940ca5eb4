"""Every tissue law: its formulas are derivatives of each other, agree with Hooke's law, and avoid cancellation."""

import numpy as np
import pytest
from oracle import EVERY_LAW, energy_density, piola, tissue

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


def test_sampled_strains_invert_elements_if_law_permits(name: str) -> None:
    J = np.linalg.det(np.eye(3) + gradients(name))
    assert J.max() > 2.0
    assert (J.min() < -0.2) == (name not in POSITIVE)


def test_energy_agrees_with_published_formula(name: str, double: Evaluator) -> None:
    H = gradients(name)
    expected = energy_density(name, np.eye(3) + H, *tissue(name).coefficients)
    np.testing.assert_allclose(double(H).energy, expected, rtol=1e-11, atol=1e-9)


def test_stress_agrees_with_published_formula(name: str, double: Evaluator) -> None:
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


def test_law_curvature_is_symmetric(name: str, double: Evaluator) -> None:
    H = gradients(name)
    D, E = np.random.default_rng(6).normal(size=(2, *H.shape))
    one = np.einsum("nij,nij->n", double(H, D).change, E)
    other = np.einsum("nij,nij->n", double(H, E).change, D)
    np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-7)


@pytest.mark.parametrize(("young", "poisson"), [(3000.0, 0.45), (1.0e4, 0.0), (500.0, 0.4945), (3000.0, -0.3)])
def test_small_strain_stress_agrees_with_hookes_law(name: str, double: Evaluator, young: float, poisson: float) -> None:
    """Uniaxial stress of 1e-6 E stretches by 1e-6 and contracts by nu 1e-6; a shear strain gives E / (2 (1 + nu))."""
    stretch = 1e-6 * np.diag([1.0, -poisson, -poisson])
    shear = 1e-6 * (np.eye(3)[[1]].T @ np.eye(3)[[0]] + np.eye(3)[[0]].T @ np.eye(3)[[1]])
    stress = double(np.stack([stretch, shear]), tissue=tissue(name, young, poisson)).stress
    np.testing.assert_allclose(stress[0], 1e-6 * young * np.diag([1.0, 0.0, 0.0]), atol=1e-10 * young)
    np.testing.assert_allclose(stress[1], shear * young / (1.0 + poisson), atol=1e-10 * young)


def test_rotation_keeps_energy_and_rotates_stress(name: str, double: Evaluator) -> None:
    if name == "linear":
        pytest.skip("small strain is not invariant, and says so")
    H = gradients(name)
    Q = rotations(len(H))
    turned = double(Q @ (np.eye(3) + H) - np.eye(3))
    still = double(H)
    np.testing.assert_allclose(turned.energy, still.energy, rtol=1e-10)
    assert relative(turned.stress - Q @ still.stress, still.stress).max() < 1e-9
    assert np.abs(double(Q - np.eye(3)).stress).max() < 1e-9 * MU


def test_linear_law_has_energy_under_rotation(double: Evaluator, name: str) -> None:
    if name == "linear":
        assert double(rotations(3) - np.eye(3)).energy.min() > 0.01 * MU


def test_tissue_law_is_isotropic(name: str, double: Evaluator) -> None:
    H = gradients(name)
    Q = rotations(len(H))
    turned = double(Q @ H @ Q.transpose(0, 2, 1))
    np.testing.assert_allclose(turned.energy, double(H).energy, rtol=1e-10)


def test_stress_and_energy_at_rest_are_exactly_zero(name: str, double: Evaluator, single: Evaluator) -> None:
    for evaluate in (double, single):
        at_rest = evaluate(np.zeros((1, 3, 3)))
        assert not at_rest.stress.any()
        assert not at_rest.energy.any()


@pytest.mark.parametrize("size", [1e-5, 1e-4, 1e-3])
def test_single_precision_stress_is_accurate_at_small_strain(
    name: str, single: Evaluator, double: Evaluator, size: float
) -> None:
    H = np.random.default_rng(7).normal(0.0, size, (200, 3, 3)).astype(np.float32).astype(np.float64)
    exact = double(H)
    assert relative(single(H).stress - exact.stress, exact.stress).max() < 1e-5
    np.testing.assert_allclose(single(H).energy, exact.energy, rtol=1e-5)


def test_single_precision_stress_is_accurate_at_large_strain(name: str, single: Evaluator, double: Evaluator) -> None:
    H = gradients(name, spread=0.3).astype(np.float32).astype(np.float64)
    D = np.random.default_rng(8).normal(size=H.shape)
    exact = double(H, D)
    assert relative(single(H).stress - exact.stress, exact.stress).max() < 1e-4
    assert np.median(relative(single(H, D).change - exact.change, exact.change)) < 1e-5


@pytest.mark.parametrize("law", POSITIVE)
def test_energy_of_logarithmic_laws_is_infinite_if_inverted(law: str) -> None:
    evaluate = build_evaluator(tissue(law), "float64")
    assert np.isposinf(evaluate(np.diag([-2.0, 0.0, 0.0])[None]).energy).all()
    assert np.isposinf(evaluate(np.diag([-1.0, 0.0, 0.0])[None]).energy).all()
