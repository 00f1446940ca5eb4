"""The power series of an answer in the size of its load: held to equilibria that Newton finds."""

import numpy as np
import pytest

from sim.accuracy import REFERENCE, TRAIN
from sim.effects import Elasticity, Held, NodalForce, Slide, ToolDisplacement, ToolForce
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Displaced, Loads, Pushed
from sim.material import LAWS, Material

EFFECTS = (Held(), Slide(), ToolForce(), NodalForce())
POINT, RADIUS = np.array([[2e-3, 1e-3, 0.0], [-8e-3, 4e-3, 0.0]]), np.array([6e-3, 9e-3])
FORCE = np.array([[0.02, 0.01, -0.15], [0.0, -0.05, -0.2]])


def pushes(share):
    return Loads((Pushed(POINT, share * FORCE, RADIUS),))


@pytest.mark.parametrize("element", ["p1", "smoothed"])
@pytest.mark.parametrize("law", [law for law in LAWS if law != "linear"])
def test_what_is_left_falls_with_the_fourth_power(box, law, element):
    fem = Fem(box, (Elasticity(Material(law, 3000.0, 0.45)), *EFFECTS), REFERENCE, "cpu", element=element)
    nodes = box.tumour_nodes
    terms = fem.series(pushes(1.0), 3, nodes)
    assert terms.shape == (3, 2, len(nodes), 3)
    left = []
    for share in (0.2, 0.1):
        told = sum(share**order * term for order, term in enumerate(terms, start=1))
        left.append(np.linalg.norm(told - fem.deform(pushes(share), at=nodes).displacement, axis=(1, 2)))
    assert (np.log2(left[0] / left[1]) > 3.7).all() and (np.log2(left[0] / left[1]) < 4.6).all()


def test_a_linear_body_has_one_order_only(box):
    fem = Fem(box, (Elasticity(Material("linear", 3000.0, 0.45)), *EFFECTS), REFERENCE, "cpu", element="p1")
    nodes = np.arange(len(box.mesh.nodes))
    first, second, third = fem.series(pushes(1.0), 3, nodes)
    assert np.allclose(first, fem.deform(pushes(1.0)).displacement, atol=1e-7 * np.abs(first).max())
    assert max(np.abs(second).max(), np.abs(third).max()) < 1e-6 * np.abs(first).max()


def test_without_an_inverse_of_the_rest_stiffness_it_is_the_same(box):
    effects = (Elasticity(), *EFFECTS)
    direct = Fem(box, effects, REFERENCE, "cpu", element="smoothed")
    iterated = Fem(box, effects, REFERENCE, "cpu", element="smoothed")
    iterated.__dict__["_exact"] = None
    nodes = box.tumour_nodes
    one, other = direct.series(pushes(1.0), 3, nodes), iterated.series(pushes(1.0), 3, nodes)
    for order in range(3):
        assert np.allclose(one[order], other[order], atol=1e-5 * np.abs(one[order]).max())


def test_no_load_has_a_series_of_nothing(box):
    fem = Fem(box, (Elasticity(), *EFFECTS), REFERENCE, "cpu", element="p1")
    assert not fem.series(pushes(0.0), 3, box.tumour_nodes).any()


def test_what_has_no_series_is_refused(box):
    with pytest.raises(InputError, match="float64"):
        Fem(box, (Elasticity(), *EFFECTS), TRAIN, "cpu").series(pushes(1.0), 3, box.tumour_nodes)
    fem = Fem(box, (Elasticity(), *EFFECTS, ToolDisplacement()), REFERENCE, "cpu")
    with pytest.raises(InputError, match="Displaced is no force"):
        fem.series(Loads((Displaced(POINT, 0.01 * FORCE, RADIUS),)), 3, box.tumour_nodes)
    with pytest.raises(InputError, match="no vertex 99999"):
        fem.series(pushes(1.0), 3, np.array([99999]))
