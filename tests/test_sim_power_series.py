"""Power series of a displacement in the size of its load, against equilibria of Newton's method."""

import numpy as np
import pytest
import warp as wp

from sim.accuracy import REFERENCE, TRAIN
from sim.discretisation.footprint import compute_footprint_weights
from sim.effects import Elasticity, Held, NodalForce, Slide, ToolDisplacement, ToolForce
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Displaced, Loads, Nodal, Pushed
from sim.material import LAWS, Material
from sim.minimisers.power_series import (
    build_mixing_kernel,
    choose_unit_directions,
    compute_monomials,
    count_terms,
    mix_columns,
)
from sim.runtime.device import find_device

EFFECTS = (Held(), Slide(), ToolForce(), NodalForce())
POINT, RADIUS = np.array([[2e-3, 1e-3, 0.0], [-8e-3, 4e-3, 0.0]]), np.array([6e-3, 9e-3])
FORCE = np.array([[0.02, 0.01, -0.15], [0.0, -0.05, -0.2]])


def pushes(share):
    return Loads((Pushed(POINT, share * FORCE, RADIUS),))


def series(fem, loads, orders, nodes, sizes=1):
    """(terms, G, n, 3)."""
    reading = fem.build_reading(nodes, np.eye(3 * len(nodes)).reshape(-1, len(nodes), 3))
    found = fem.compute_series(loads, orders, reading, sizes)
    return np.moveaxis(found.reshape(*found.shape[:2], len(nodes), 3), 1, 0)


@pytest.mark.parametrize("element", ["p1", "smoothed"])
@pytest.mark.parametrize("law", [law for law in LAWS if law != "linear"])
def test_series_error_falls_with_fourth_power_of_load(box, law, element):
    fem = Fem(box, (Elasticity(Material(law, 3000.0, 0.45)), *EFFECTS), REFERENCE, "cpu", element=element)
    nodes = box.tumour_nodes
    terms = series(fem, pushes(1.0), 3, nodes)
    assert terms.shape == (3, 2, len(nodes), 3)
    left = []
    for share in (0.2, 0.1):
        predicted = sum(share**order * term for order, term in enumerate(terms, start=1))
        left.append(np.linalg.norm(predicted - fem.deform(pushes(share), at=nodes).displacement, axis=(1, 2)))
    assert (np.log2(left[0] / left[1]) > 3.7).all() and (np.log2(left[0] / left[1]) < 4.6).all()


def test_linear_body_has_only_first_order_terms(box):
    fem = Fem(box, (Elasticity(Material("linear", 3000.0, 0.45)), *EFFECTS), REFERENCE, "cpu", element="p1")
    nodes = np.arange(len(box.mesh.nodes))
    first, second, third = series(fem, pushes(1.0), 3, nodes)
    assert np.allclose(first, fem.deform(pushes(1.0)).displacement, atol=1e-7 * np.abs(first).max())
    assert max(np.abs(second).max(), np.abs(third).max()) < 1e-6 * np.abs(first).max()


def test_series_of_zero_load_is_zero(box):
    fem = Fem(box, (Elasticity(), *EFFECTS), REFERENCE, "cpu", element="p1")
    assert not series(fem, pushes(0.0), 3, box.tumour_nodes).any()


def test_series_of_several_loads_has_fourth_order_error(box):
    fem = Fem(box, (Elasticity(Material("neo-hookean", 3000.0, 0.45)), *EFFECTS), REFERENCE, "cpu", element="p1")
    nodes = box.tumour_nodes
    point, radius = np.repeat(POINT[:1], 3, axis=0) + [[0, 0, 0], [0, 0, 0], [4e-3, 0, 0]], np.full(3, 7e-3)
    force = 0.15 * np.eye(3)[[2, 0, 1]]
    terms = series(fem, Loads((Pushed(point, force, radius),)), 3, nodes, 3)
    assert terms.shape == (19, 1, len(nodes), 3) and count_terms(3, 3) == 19
    sizes, left = np.array([[-0.9, 0.3, -0.5], [-0.5, -0.8, 0.2]]), []
    for share in (0.4, 0.2):
        factor = np.concatenate([compute_monomials(share * sizes, order) for order in (1, 2, 3)])
        predicted = np.einsum("tb,tnk->bnk", factor, terms[:, 0])
        shares = share * sizes
        nodal = np.einsum("bs,snk->bnk", shares, _nodal(box, point, force, radius))
        left.append(np.linalg.norm(predicted - fem.deform(Loads((Nodal(nodal),)), at=nodes).displacement, axis=(1, 2)))
    assert (np.log2(left[0] / left[1]) > 3.7).all() and (np.log2(left[0] / left[1]) < 4.6).all()


def _nodal(box, point, force, radius):
    """The forces (B, V, 3) at every vertex."""
    weights = compute_footprint_weights(box.mesh.nodes, box.mesh.surface, point, radius).toarray()
    return weights[:, :, None] * force[:, None, :]


def test_series_along_one_direction_agrees_with_single_load(box):
    fem = Fem(box, (Elasticity(), *EFFECTS), REFERENCE, "cpu", element="smoothed")
    nodes, direction = box.tumour_nodes, np.array([[0.5, -0.4, -0.7]])
    three = Pushed(np.repeat(POINT[:1], 3, axis=0), np.eye(3), np.repeat(RADIUS[:1], 3))
    terms = series(fem, Loads((three,)), 3, nodes, 3)[:, 0]
    single = series(fem, Loads((Pushed(POINT[:1], direction, RADIUS[:1]),)), 3, nodes)[:, 0]
    for order, (rows, wanted) in enumerate(zip(np.split(terms, [3, 9]), single, strict=True), start=1):
        predicted = np.einsum("tb,tnk->nk", compute_monomials(direction, order), rows)
        assert np.linalg.norm(predicted - wanted) < 2e-3 * np.linalg.norm(wanted)


@pytest.mark.parametrize("sizes", [1, 2, 3])
@pytest.mark.parametrize("order", [1, 2, 3])
def test_unit_directions_determine_every_product(sizes, order):
    values = compute_monomials(choose_unit_directions(sizes, order), order)
    assert values.shape[0] == values.shape[1] and np.linalg.cond(values) < 14.0


def test_column_mixing_by_warp_agrees_with_numpy():
    device = find_device("cpu", "float64")
    random = np.random.default_rng(0)
    x, weight = device.upload(random.normal(size=(7, 12))), random.normal(size=(3, 5))
    by_warp = device.allocate(7, 20)
    device.launch(build_mixing_kernel(device), (7, 4), [x, device.upload(weight)], [by_warp])
    wanted = np.einsum("rgt,tj->rgj", x.numpy().reshape(7, 4, 3), weight).reshape(7, 20)
    assert np.allclose(by_warp.numpy(), wanted) and np.allclose(mix_columns(device, x, weight).numpy(), wanted)


@pytest.mark.gpu
@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device here")
def test_cuda_series_agrees_with_cpu(box):
    force = Pushed(np.repeat(POINT, 3, axis=0), np.tile(np.eye(3), (2, 1)), np.repeat(RADIUS, 3))
    one, other = (
        series(Fem(box, (Elasticity(), *EFFECTS), REFERENCE, name, element="smoothed"), Loads((force,)), 3,
               box.tumour_nodes, 3)
        for name in ("cpu", "cuda")
    )  # fmt: skip
    for rows in (slice(0, 3), slice(3, 9), slice(9, 19)):
        assert np.allclose(one[rows], other[rows], atol=1e-4 * np.abs(one[rows]).max())


def test_series_is_independent_of_batch_size_and_reading(box):
    whole = Fem(box, (Elasticity(), *EFFECTS), REFERENCE, "cpu", element="p1")
    some = Fem(box, (Elasticity(), *EFFECTS), REFERENCE, "cpu", element="p1", batch=1)
    nodes, modes = box.tumour_nodes, np.random.default_rng(0).normal(size=(4, len(box.tumour_nodes), 3))
    wanted = np.einsum("tgnk,rnk->gtr", series(whole, pushes(1.0), 3, nodes), modes)
    for fem in (whole, some):
        found = fem.compute_series(pushes(1.0), 3, fem.build_reading(nodes, modes))
        assert np.allclose(found, wanted, atol=1e-6 * np.abs(wanted).max(axis=(0, 2))[None, :, None])


def test_unsupported_series_are_rejected(box):
    with pytest.raises(InputError, match="float64"):
        series(Fem(box, (Elasticity(), *EFFECTS), TRAIN, "cpu", element="p1"), pushes(1.0), 3, box.tumour_nodes)
    fem = Fem(box, (Elasticity(), *EFFECTS, ToolDisplacement()), REFERENCE, "cpu", element="p1")
    with pytest.raises(InputError, match="not `Displaced`"):
        series(fem, Loads((Displaced(POINT, 0.01 * FORCE, RADIUS),)), 3, box.tumour_nodes)
    with pytest.raises(InputError, match="no vertex 99999"):
        fem.build_reading(np.array([99999]), np.ones((1, 1, 3)))
    with pytest.raises(InputError, match="2 loads cannot be grouped by 3"):
        series(fem, pushes(1.0), 3, box.tumour_nodes, 3)


def test_series_beyond_free_memory_is_rejected(box, monkeypatch):
    fem = Fem(box, (Elasticity(), *EFFECTS), REFERENCE, "cpu", element="p1")
    reading = fem.build_reading(box.tumour_nodes, np.ones((1, len(box.tumour_nodes), 3)))
    monkeypatch.setattr("sim.runtime.memory.measure_host_bytes", lambda budget: 2_000_000)
    with pytest.raises(InputError, match="free"):
        fem.compute_series(pushes(1.0), 3, reading)
    with pytest.raises(InputError, match="free"):
        fem.build_reading(box.tumour_nodes, np.ones((50, len(box.tumour_nodes), 3)))
