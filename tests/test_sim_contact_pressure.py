"""Contact pressure: uniform under a plate, force over area; largest under the lower end of a blade."""

import numpy as np
import pytest
from boxes import base_held, box
from scipy.spatial.transform import Rotation

from sim.accuracy import Accuracy
from sim.contact_pressure import compute_pressure
from sim.effects import Effect, Elasticity, Held, NodalForce, Retraction, ToolContact
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads, Retracted, Touching
from sim.material import Material
from sim.tools import Ball, Spatula

SIDE, HEIGHT = 0.06, 0.03
BLOCK = base_held(box((6, 6, 3), SIDE))
TOP = BLOCK.mesh.nodes[:, 2] > HEIGHT - 1e-9


def at(*place: float, tip: float = 0.0) -> np.ndarray:
    """T_world_tool (4, 4) at a place [m], its end towards -y lower by an angle [degrees]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("x", tip, degrees=True).as_matrix(), place
    return T


@pytest.mark.parametrize("element", ["p1", "smoothed"])
def test_plate_pressure_is_uniform_force_over_area(element: str) -> None:
    """Tissue with Poisson's ratio zero: Young's modulus times the strain, at every vertex far from the plate's edge."""
    plate = Spatula(0.1, 0.1, 5e-3)
    effects = (Elasticity(Material("linear", 3000.0, 0.0)), Held(), ToolContact((plate,)))
    fem = Fem(BLOCK, effects, Accuracy(tolerance=1e-9), "cpu", element=element)
    poses = np.stack([at(0.03, 0.03, HEIGHT - depth)[None] for depth in (1e-3, 3e-3)])
    loads = Loads((Touching(poses),))
    answer = fem.deform(loads)
    found = compute_pressure(fem, loads, answer)
    inner = TOP & ((BLOCK.mesh.nodes[:, :2] > 1e-9) & (BLOCK.mesh.nodes[:, :2] < SIDE - 1e-9)).all(axis=1)
    squeezed = -answer.displacement[:, inner, 2].mean(axis=1) / HEIGHT
    np.testing.assert_allclose(found[:, inner], np.repeat(3000.0 * squeezed[:, None], inner.sum(), axis=1), rtol=1e-4)
    np.testing.assert_allclose(found[:, inner].mean(axis=1), -answer.reaction[:, 0, 2] / SIDE**2, rtol=2e-2)
    assert not found[:, ~TOP & (BLOCK.mesh.nodes[:, 2] < HEIGHT - 0.011)].any()


def test_blade_pressure_is_largest_at_its_lower_end() -> None:
    fem = Fem(BLOCK, (Elasticity(), Held(), Retraction(Spatula(0.015, 0.03, 2e-3))), Accuracy(), "cpu", element="p1")
    laid, moved = at(0.03, 0.03, HEIGHT + 5e-3, tip=12.0), np.array([[0.0, 0.0, -8e-3]])
    loads = Loads((Retracted(laid[None], moved),))
    answer = fem.deform(loads)
    found = compute_pressure(fem, loads, answer)[0]
    assert answer.outcome[0].good
    along = BLOCK.mesh.nodes[:, 1] - 0.03
    ends = [found[TOP & (along * way > 4e-3)].max() for way in (-1.0, 1.0)]
    assert ends[0] > 3.0 * ends[1] and 200.0 < ends[0] < 5000.0


def test_pressure_without_contact_is_zero() -> None:
    fem = Fem(BLOCK, (Elasticity(), Held(), ToolContact((Ball(5e-3),))), Accuracy(), "cpu", element="p1")
    loads = Loads((Touching(at(0.03, 0.03, HEIGHT + 1e-3)[None, None]),))
    assert not compute_pressure(fem, loads, fem.deform(loads)).any()


def test_pressure_requires_full_result_and_its_loads() -> None:
    fem = Fem(BLOCK, (Elasticity(), Held(), ToolContact((Ball(5e-3),))), Accuracy(), "cpu", element="p1")
    loads = Loads((Touching(at(0.03, 0.03, HEIGHT + 1e-3)[None, None]),))
    answer, none = fem.deform(loads), np.zeros(0, int)
    with pytest.raises(InputError, match="1 load cases at 2 vertices, the loads have 1, and the body 196"):
        compute_pressure(fem, loads, answer.restrict(np.arange(2)))
    with pytest.raises(InputError, match="1 load cases at 196 vertices, the loads have 0"):
        compute_pressure(fem, loads.select(none), answer)
    assert compute_pressure(fem, loads.select(none), answer.select(none)).shape == (0, 196)


@pytest.mark.parametrize(
    ("effect", "element", "sentence"),
    [(NodalForce(), "p1", "nothing touches this body: add ToolContact"), (ToolContact((Ball(5e-3),)), "p2", "with p1")],
)
def test_pressure_without_contact_effect_is_rejected(effect: Effect, element: str, sentence: str) -> None:
    fem = Fem(BLOCK, (Elasticity(), Held(), effect), Accuracy(), "cpu", element=element)
    loads = Loads((), np.zeros(1))
    with pytest.raises(InputError, match=sentence):
        compute_pressure(fem, loads, fem.deform(loads))
