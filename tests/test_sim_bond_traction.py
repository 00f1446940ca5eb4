"""Bonded skull: it holds its nodes, prevents penetration and reports its traction as a share of the strength."""

import numpy as np
import pytest
from boxes import box, hold, top_forces

from sim.accuracy import REFERENCE
from sim.effects import SKULLS, Bonded, Elasticity, Held, NodalForce, SkullContact, Slide
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads, Nodal
from sim.material import Material

TISSUE = Material("neo-hookean", 3000.0, 0.4)
SIDE = 2e-3  # [m]: all of the base lies within the mean of its tractions
PULL, PRESS = np.array([3e-4, -2e-4, 5e-4]), np.array([3e-4, -2e-4, -5e-4])  # [N]


@pytest.fixture(scope="module")
def cube():
    mesh = box((3, 3, 3), SIDE, distortion=0.2)
    base = mesh.nodes[:, 2] < 1e-9
    return hold(mesh, np.zeros(len(base), bool), np.where(base[:, None], [0.0, 0.0, -1.0], 0.0))


def answered(anatomy, effect, total, element, device="cpu"):
    effects = (Elasticity(TISSUE), Held(), effect, NodalForce())
    loads = Loads((Nodal(top_forces(anatomy.mesh, total)),))
    return Fem(anatomy, effects, REFERENCE, device, element=element).deform(loads)


@pytest.mark.parametrize("element", ["p1", "smoothed", "p2"])
@pytest.mark.parametrize("total", [PULL, PRESS])
def test_bond_share_is_mean_traction_over_strength(cube, element, total):
    """Force over area: the base bears the pull on the top; pressure has no limit."""
    answer = answered(cube, Bonded(300.0, 200.0), total, element)
    traction = np.abs(total) / SIDE**2
    pull = traction[2] / 300.0 if total[2] > 0.0 else 0.0
    assert answer.bond[0] == pytest.approx(np.hypot(pull, np.hypot(*traction[:2]) / 200.0), rel=1e-6)
    assert answer.select(np.array([0])).bond[0] == answer.bond[0]


def test_bonded_skull_fixes_its_nodes_like_held_nodes(cube):
    held = hold(cube.mesh, cube.slide_normal.any(axis=1))
    bonded, fast = (answered(one, Bonded(), PULL, "smoothed") for one in (cube, held))
    np.testing.assert_allclose(bonded.displacement, fast.displacement, atol=1e-12)
    assert not bonded.displacement[0, cube.slide_normal.any(axis=1)].any() and bonded.leaked[0] == 0.0


def test_bond_traction_ratio_is_nan_without_bond(cube):
    mesh, base = cube.mesh, cube.slide_normal.any(axis=1)
    loose = hold(mesh, base & (mesh.nodes[:, 0] < SIDE / 2), cube.slide_normal)
    assert np.isnan(answered(loose, Slide(), PULL, "p1").bond).all()


def test_contradicting_skull_models_are_rejected(cube):
    for other in (Slide(), SkullContact()):
        with pytest.raises(InputError, match=f"Bonded and {type(other).__name__} are alternative contact models"):
            Fem(cube, (Elasticity(TISSUE), Held(), Bonded(), other, NodalForce()), device="cpu")
    with pytest.raises(InputError, match=r"Bonded.shear is 0.0 Pa"):
        Bonded(shear=0.0)
    assert list(SKULLS) == ["bonded", "slide", "contact"]
