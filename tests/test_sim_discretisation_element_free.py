"""Element-free Galerkin: patch tests, convergence to quadratic elements, two tissues, and hard cases."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import box, hold, surface_nodes
from test_sim_smoothed import deflection

from sim.accuracy import Accuracy
from sim.deformation import Deformation
from sim.discretisation.element import Elements
from sim.discretisation.element_free import compute_shape_functions
from sim.discretisation.space import discretise
from sim.effects import Elasticity, Held
from sim.fem import Fem
from sim.geometry.tetmesh import MeshWarning, TetMesh
from sim.loads import Loads, Prescribed
from sim.material import Material

BLOCK = box((6, 6, 6), 0.1, distortion=0.1)
TWO = replace(BLOCK, region=(np.abs(BLOCK.nodes[BLOCK.tets].mean(axis=1) - 0.05).max(axis=1) < 0.018).astype(int))
"""A block with an inclusion, region 1."""
INSIDE = ~surface_nodes(BLOCK)
ELEMENT = "element-free"
SOFT = Material("neo-hookean", 3000.0, 0.45)
TIGHT = Accuracy(tolerance=1e-6)


def cells(mesh: TetMesh) -> Elements:
    (part,) = discretise(mesh, ELEMENT).build_elements(np.ones(len(mesh.tets), bool))
    return part.elements


def solve(mesh: TetMesh, motion: list[float], *tissues: Material, element: str = ELEMENT) -> Deformation:
    """The block between its base and its top, which moves [m]."""
    base, top = mesh.nodes[:, 2] < 1e-9, mesh.nodes[:, 2] > 0.1 - 1e-9
    effects = Elasticity(regions=dict(enumerate(tissues))), Held()
    loads = Loads((Prescribed(np.where(top[:, None], motion, 0.0)[None]),))
    return Fem(hold(mesh, base | top), effects, TIGHT, "cpu", element=element).deform(loads)


def relative_error(found: Deformation, exact: Deformation, nodes: np.ndarray) -> float:
    off = (found.displacement - exact.displacement)[0, nodes]
    return float(np.linalg.norm(off, axis=1).mean() / np.linalg.norm(exact.displacement[0, nodes], axis=1).mean())


def test_gradients_are_exact_for_linear_fields() -> None:
    """Rigid motions cause no strain, and constant stress is in equilibrium with tractions on linear triangles."""
    elements = cells(TWO)
    slope = np.einsum("tqai,taj->tqij", elements.gradient, TWO.nodes[elements.table])
    np.testing.assert_allclose(slope, np.broadcast_to(np.eye(3), slope.shape), atol=1e-12)
    assert np.abs(elements.gradient.sum(axis=2)).max() < 1e-9
    assert elements.weight.sum() == pytest.approx(1e-3)
    total = np.zeros_like(TWO.nodes)
    np.add.at(total, elements.table, elements.weight[..., None] * elements.gradient[:, 0])
    linear = np.zeros_like(total)
    a, b, c = np.moveaxis(TWO.nodes[TWO.surface], 1, 0)
    np.add.at(linear, TWO.surface, (np.cross(b - a, c - a) / 6.0)[:, None])
    np.testing.assert_allclose(total, linear, atol=1e-15)


def test_element_free_supports_cross_no_interface() -> None:
    elements = cells(TWO)
    assert elements.sizes is not None and np.median(elements.sizes) >= 12 and elements.sizes.max() <= 40
    used = np.arange(elements.table.shape[1]) < elements.sizes[:, None]
    for label in (0, 1):
        mine = TWO.region[elements.owner] == label
        assert np.isin(elements.table[mine][used[mine]], TWO.find_nodes(label)).all()


def test_element_free_shapes_interpolate_at_nodes() -> None:
    nodes = np.random.default_rng(0).uniform(size=(20, 14, 3))
    for a in range(14):
        shape = compute_shape_functions(nodes[:, a], nodes, np.ones((20, 14), bool))
        np.testing.assert_allclose(shape, np.broadcast_to(np.eye(14)[a], shape.shape), atol=1e-4)


@pytest.mark.parametrize("law", ["linear", "neo-hookean"])
def test_patch_test_with_large_strain_is_exact(law: str) -> None:
    slope = np.array([[0.2, 0.1, 0.0], [-0.1, -0.15, 0.05], [0.0, 0.1, 0.1]])
    value, effects = BLOCK.nodes @ slope.T, (Elasticity(replace(SOFT, law=law)), Held())
    loads = Loads((Prescribed(np.where(INSIDE[:, None], 0.0, value)[None]),))
    found = Fem(hold(BLOCK, ~INSIDE), effects, Accuracy(1e-9, precision="float64"), "cpu", element=ELEMENT)
    np.testing.assert_allclose(found.deform(loads).displacement[0], value, atol=1e-8)


def test_element_free_refinement_converges_to_quadratic_elements() -> None:
    exact = deflection("p2", 5, 0.45)
    off = [abs(deflection(ELEMENT, width, 0.45) / exact - 1.0) for width in (2, 3, 6)]
    assert off[0] > off[1] > off[2] and off[2] < 0.02
    assert abs(deflection("p1", 6, 0.45) / exact - 1.0) > 10.0 * off[2]


def test_large_strain_agrees_with_quadratic_elements() -> None:
    """A fifth of the height pressed and sheared."""
    exact, found, linear = (solve(BLOCK, [0.02, 0.0, -0.02], SOFT, element=name) for name in ("p2", ELEMENT, "p1"))
    assert found.outcome[0].good and found.stretch[0, 0] < 0.7
    assert relative_error(found, exact, INSIDE) < 0.03 < 0.05 < relative_error(linear, exact, INSIDE)


def test_stiff_inclusion_agrees_with_quadratic_elements() -> None:
    tissues, stiff = (SOFT, replace(SOFT, young=30e3)), TWO.find_nodes(1)
    exact, found, linear = (solve(TWO, [0.02, 0.0, -0.01], *tissues, element=name) for name in ("p2", ELEMENT, "p1"))
    assert found.outcome[0].good and relative_error(found, exact, stiff) < 0.03 < relative_error(linear, exact, stiff)


@pytest.mark.parametrize("poisson", [0.49, 0.499])
def test_nearly_incompressible_tissue_has_finite_result(poisson: float) -> None:
    found = solve(BLOCK, [0.02, 0.0, -0.01], replace(SOFT, poisson=poisson))
    assert found.outcome[0].good and np.isfinite(found.displacement).all()


def test_overload_of_element_free_body_is_reported() -> None:
    """Pressed to a third of the height."""
    found = solve(BLOCK, [0.0, 0.0, -0.07], SOFT)
    assert np.isfinite(found.displacement).all() and not found.outcome[0].good


def test_slivers_keep_element_free_gradients_bounded() -> None:
    """A node near the opposite face of one of its tetrahedra, which keeps a thousandth of its height."""
    mesh = box((6, 6, 6), 0.1)
    tet = mesh.tets[np.flatnonzero(INSIDE[mesh.tets].any(axis=1))[0]]
    node, nodes = tet[INSIDE[tet]][0], mesh.nodes.copy()
    nodes[node] += 0.999 * (nodes[tet[tet != node]].mean(axis=0) - nodes[node])
    with pytest.warns(MeshWarning, match="2 tetrahedra"):
        flat = TetMesh(nodes, mesh.tets, mesh.region)
    found, exact = (solve(flat, [0.01, 0.0, -0.01], SOFT, element=name) for name in (ELEMENT, "p2"))
    assert flat.volumes.min() < 2e-3 * mesh.volumes.min() and found.outcome[0].good
    assert relative_error(found, exact, INSIDE) < 0.03
