"""The second order of forces on nodes: every law and element against the power series of differences."""

import numpy as np
import pytest
from conftest import make_box

from sim.accuracy import REFERENCE
from sim.effects import NodalForce, build_push_effects
from sim.fem import Fem
from sim.loads import Loads, Nodal
from sim.material import Material
from sim.minimisers.second_order import compute_second_order
from sim.named_tissues import MATERIALS


@pytest.fixture(scope="module")
def tiny_box():
    return make_box(cells=(6, 6, 4), spacing=9e-3, tumour=12e-3, depth=20e-3, opening=20e-3)


@pytest.mark.parametrize(
    ("law", "element"),
    [("neo-hookean", "smoothed"), ("stable-neo-hookean", "p1"), ("corotational", "p1"), ("neo-hookean", "p2")],
)
def test_load_pairs_agree_with_second_order_of_series(tiny_box, law, element):
    check(tiny_box, Material(law, 3000.0, 0.45), element)


def test_load_pairs_agree_for_a_stiffening_tissue(tiny_box):
    check(tiny_box, MATERIALS["minutes"].tissue, "p1")


def check(box, tissue, element):
    """Forces on four nodes at once, of which all pairs are wanted, and of which some are."""
    fem = Fem(box, (*build_push_effects(box, tissue), NodalForce()), REFERENCE, "cpu", element=element)
    nodes, asked = np.unique(box.open_surface)[[0, 2, 3, 7]], box.tumour_nodes[:5]
    random = np.random.default_rng(3)
    force = random.normal(size=(6, 4, 3)) * 1e-2
    field = np.zeros((6, len(box.mesh.nodes), 3))
    field[:, nodes] = force
    reading = fem.build_reading(asked, np.eye(3 * len(asked)).reshape(-1, len(asked), 3))
    wanted = fem.compute_series(Loads((Nodal(field),)), 2, reading)[:, 1]
    units = fem.build_reading(nodes, np.eye(12).reshape(-1, 4, 3))
    near = np.ones((4, 4), bool)
    heard = []
    pairs, table = compute_second_order(
        fem.problem, units.solutions, reading.solutions, near, lambda done, total: heard.append((done, total))
    )
    assert len(pairs) == 12 * 13 // 2 and (pairs[:, 0] <= pairs[:, 1]).all() and heard[-1][0] == heard[-1][1]
    flat = force.reshape(6, -1)
    found = (flat[:, pairs[:, 0]] * flat[:, pairs[:, 1]]) @ table
    assert np.linalg.norm(found - wanted) < 2e-4 * np.linalg.norm(wanted)
    near[0, 3] = near[3, 0] = False
    fewer, part = compute_second_order(fem.problem, units.solutions, reading.solutions, near)
    kept = ~((pairs[:, 0] // 3 == 0) & (pairs[:, 1] // 3 == 3))
    np.testing.assert_array_equal(fewer, pairs[kept])
    np.testing.assert_allclose(part, table[kept], rtol=1e-4, atol=1e-5 * np.abs(table).max())
