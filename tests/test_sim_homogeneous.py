"""Nominal stresses in homogeneous deformations against closed forms."""

import numpy as np
import pytest

from sim.diagnostics.homogeneous import compute_shear_stress, compute_uniaxial_stress
from sim.errors import InputError
from sim.material import LAWS, Material, Ogden

STRETCH, SHEAR = np.array([0.8, 0.9, 0.97, 1.0, 1.05, 1.1, 1.2]), np.array([-0.2, 0.0, 0.05, 0.2, 0.4])
MU = 800.0


def make_ogden(alpha, ratio=1e5):
    """Ogden's law with a bulk modulus of `ratio` shear moduli."""
    return Ogden(((2.0 * MU, alpha),), ratio * MU)


@pytest.mark.parametrize("alpha", [-23.6, -4.7, 2.0, 8.0])
def test_ogden_stresses_equal_incompressible_closed_forms(alpha):
    """Uniaxial: 2 mu / alpha (l^(alpha - 1) - l^(-alpha / 2 - 1)); shear: principal stretches l and 1 / l."""
    tissue = make_ogden(alpha)
    wanted = 2.0 * MU / alpha * (STRETCH ** (alpha - 1.0) - STRETCH ** (-alpha / 2.0 - 1.0))
    np.testing.assert_allclose(compute_uniaxial_stress(tissue, STRETCH), wanted, rtol=2e-3, atol=1e-3)
    root = np.sqrt(1.0 + SHEAR**2 / 4.0)
    large = SHEAR / 2.0 + root
    change = 2.0 * MU / alpha * (large ** (alpha - 1.0) - large ** (-alpha - 1.0))
    np.testing.assert_allclose(
        compute_shear_stress(tissue, SHEAR), change * (0.5 + SHEAR / (4.0 * root)), rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize("law", ["neo-hookean", "stable-neo-hookean"])
def test_neo_hookean_stresses_equal_incompressible_closed_forms(law):
    tissue = Material(law, 2.0 * 1.49999 * MU, 0.49999)
    wanted = MU * (STRETCH - STRETCH**-2.0)
    np.testing.assert_allclose(compute_uniaxial_stress(tissue, STRETCH), wanted, rtol=2e-4, atol=1e-6)
    np.testing.assert_allclose(compute_shear_stress(tissue, SHEAR), MU * SHEAR, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.49])
def test_small_strain_has_youngs_and_shear_modulus(law, poisson):
    tissue = Material(law, 3000.0, poisson)
    slope = compute_uniaxial_stress(tissue, np.array([1.0 + 1e-6, 1.0 - 1e-6])) / np.array([1e-6, -1e-6])
    np.testing.assert_allclose(slope, 3000.0, rtol=1e-4)
    np.testing.assert_allclose(compute_shear_stress(tissue, np.array([1e-6])) / 1e-6, tissue.lame[0], rtol=1e-4)


def test_impossible_stretch_is_rejected():
    for stretch in (0.0, -1.0, np.nan):
        with pytest.raises(InputError, match="10 % tension"):
            compute_uniaxial_stress(make_ogden(-19.0), np.array([1.0, stretch]))
