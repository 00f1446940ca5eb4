"""A round tool on a triangulated surface: force, moment and moments of the traction do not depend on the mesh."""

from collections.abc import Callable

import numpy as np
import pytest
import warp as wp
from boxes import box
from scipy.spatial import Delaunay

from sim.discretisation.footprint import (
    CHUNK,
    ContactSurface,
    EdgeSubdivision,
    compute_footprint_weights,
    find_nearest_point,
)
from sim.errors import InputError
from sim.runtime.device import find_device

RADIUS, POINT = 0.012, np.array([0.003, -0.002, 0.0])


def sheet(count: int, seed: int = 0, half: float = 0.03) -> tuple[np.ndarray, np.ndarray]:
    """A flat square at z = 0 of scattered points: nodes (V, 3) [m], triangles (S, 3)."""
    rng = np.random.default_rng(seed)
    side = np.linspace(-half, half, 8)
    frame = [(x, y) for x in side for y in (-half, half)] + [(x, y) for x in (-half, half) for y in side[1:-1]]
    plane = np.concatenate([np.array(frame), rng.uniform(-half, half, (count, 2))])
    return np.column_stack([plane, np.zeros(len(plane))]), Delaunay(plane).simplices


def weights(nodes: np.ndarray, triangles: np.ndarray, point: np.ndarray = POINT, radius: float = RADIUS) -> np.ndarray:
    return compute_footprint_weights(nodes, triangles, point[None], np.array([radius])).toarray()[0]


@pytest.mark.parametrize("radius", [0.0005, 0.005, RADIUS, 0.02, 0.5])
def test_footprint_weights_sum_to_one(radius: float) -> None:
    weight = weights(*sheet(200), radius=radius)
    assert weight.sum() == pytest.approx(1.0, abs=1e-14)
    assert weight.min() >= 0.0


@pytest.mark.parametrize("count", [0, 30, 300, 3000])
def test_footprint_centroid_is_tool_point_on_any_mesh(count: int) -> None:
    """Linear functions are integrated exactly by linear elements: no moment about the tool point."""
    nodes, triangles = sheet(count)
    np.testing.assert_allclose(weights(nodes, triangles) @ nodes, POINT, atol=2e-3 * RADIUS)


def test_footprint_second_moment_agrees_with_traction() -> None:
    """Integral of w x^2 over integral of w is r^2 / 5 for w = sqrt(1 - s^2); interpolation on fine meshes adds h^2."""
    nodes, triangles = sheet(20000)
    second = weights(nodes, triangles) @ (nodes - POINT)[:, 0] ** 2
    assert second == pytest.approx(RADIUS**2 / 5.0, rel=0.01)


@pytest.mark.parametrize(
    ("function", "bound"),
    [
        (lambda x: 3.0 * x[:, 0] - 2.0 * x[:, 1] + 0.01, 2e-3 * 3.6 * RADIUS),
        (lambda x: x[:, 0] * x[:, 1] / RADIUS, 0.04 * RADIUS),
        (lambda x: np.sin(x[:, 0] / RADIUS) * RADIUS, 0.02 * RADIUS),
    ],
    ids=["linear", "quadratic", "sine"],
)
def test_footprints_on_meshes_of_a_surface_agree(function: Callable[[np.ndarray], np.ndarray], bound: float) -> None:
    answers = [float(weights(*mesh) @ function(mesh[0])) for mesh in (sheet(1500, 1), sheet(2500, 2))]
    assert abs(answers[0] - answers[1]) < bound


def test_small_footprint_weights_are_barycentric() -> None:
    """0.5 mm on triangles of 10 mm: three corners share the force by the point's barycentric coordinates."""
    nodes = 0.01 * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]])
    weight = weights(nodes, np.array([[0, 1, 2], [1, 3, 2]]), np.array([0.003, 0.002, 0.0]), 0.0005)
    np.testing.assert_allclose(weight, [0.5, 0.3, 0.2, 0.0], atol=2e-3)


def test_last_footprint_is_reused_for_same_point_and_radius() -> None:
    nodes, triangles = sheet(300)
    skin = ContactSurface(nodes, triangles, find_device("cpu", "float64"))
    for point, radius in ((POINT, RADIUS), (POINT, 0.5 * RADIUS), (-POINT, 0.5 * RADIUS), (POINT, RADIUS)):
        found = skin.find_footprints(point[None], np.array([radius])).to_matrix(len(nodes)).toarray()[0]
        np.testing.assert_allclose(found, weights(nodes, triangles, point, radius), atol=1e-15)


def test_surface_boundary_cuts_the_footprint() -> None:
    """Half of the disc lies outside: the force is kept and moves inwards by the half disc's centroid."""
    nodes, triangles = sheet(6000)
    at = np.array([0.03, 0.0, 0.0])
    inward = at[0] - (weights(nodes, triangles, at) @ nodes)[0]
    # Integral of x w over the half disc / integral of w: (pi/8 r^3) / (pi/3 r^2).
    assert inward == pytest.approx(3.0 / 8.0 * RADIUS, rel=0.01)


def test_tool_point_above_surface_gives_same_weights() -> None:
    nodes, triangles = sheet(300)
    above = POINT + [0.0, 0.0, 0.9 * RADIUS]
    np.testing.assert_allclose(weights(nodes, triangles, above), weights(nodes, triangles), atol=1e-15)


@pytest.mark.parametrize("offset", [[0.0, 0.0, 1.1 * RADIUS], [0.1, 0.0, 0.0], [10.0, 0.0, 0.0]])
def test_tool_point_off_the_surface_is_rejected(offset: list[float]) -> None:
    nodes, triangles = sheet(300)
    points = np.stack([POINT, POINT + offset])
    with pytest.raises(InputError, match=r"load 1 .*does not touch the surface"):
        compute_footprint_weights(nodes, triangles, points, np.full(2, RADIUS))


@pytest.mark.parametrize("radius", [1e-12, 1e-300])
def test_too_small_footprint_is_rejected(radius: float) -> None:
    """Its number of pieces would exceed the integer range."""
    with pytest.raises(InputError, match="too small for the triangles of this surface: give a radius of at least"):
        weights(*sheet(30), radius=radius)


def test_smallest_accepted_footprint_is_integrated() -> None:
    nodes, triangles = sheet(0)
    weight = weights(nodes, triangles, radius=2e-7)
    np.testing.assert_allclose(weight @ nodes, POINT, atol=1e-9)
    assert weight.sum() == pytest.approx(1.0)


def test_only_nodes_near_the_tool_are_loaded() -> None:
    nodes, triangles = sheet(3000)
    weight = weights(nodes, triangles)
    edges = nodes[triangles] - np.roll(nodes[triangles], 1, axis=1)
    longest = np.linalg.norm(edges, axis=2).max()
    distance = np.linalg.norm(nodes - POINT, axis=1)
    assert not weight[distance > RADIUS + longest].any()
    assert (weight[distance < 0.8 * RADIUS] > 0.0).all()


def test_footprint_rows_are_independent() -> None:
    mesh = box((3, 3, 3), 0.06)
    points = np.array([[0.03, 0.03, 0.06], [0.0, 0.02, 0.03], [0.06, 0.06, 0.06]])
    radii = np.array([0.01, 0.02, 0.015])
    together = compute_footprint_weights(mesh.nodes, mesh.surface, points, radii).toarray()
    for row in range(3):
        alone = compute_footprint_weights(mesh.nodes, mesh.surface, points[[row]], radii[[row]]).toarray()[0]
        np.testing.assert_array_equal(alone, together[row])


def quadratic_sheet(count: int) -> tuple[np.ndarray, np.ndarray]:
    """The scattered sheet with a node in the middle of every edge: nodes (V, 3) [m], triangles (S, 6)."""
    nodes, triangles = sheet(count)
    ends = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
    edges, place = np.unique(ends, axis=0, return_inverse=True)
    middles = len(nodes) + place.reshape(-1, 3)
    return np.vstack([nodes, nodes[edges].mean(axis=1)]), np.hstack([triangles, middles])


def test_quadratic_footprint_agrees_with_sum_over_disc() -> None:
    """Rings of points, each located in its triangle and distributed by the six shape functions."""
    nodes, triangles = quadratic_sheet(60)
    share = (np.arange(200) + 0.5) / 200.0
    angle = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
    ring = RADIUS * np.outer(share, np.exp(1j * angle)).ravel()
    points = POINT[:2] + np.column_stack([ring.real, ring.imag])
    traction = np.repeat(share * np.sqrt(1.0 - share**2), len(angle))
    a, b, c = np.moveaxis(nodes[triangles[:, :3], :2], 1, 0)
    inverse = np.linalg.inv(np.stack([b - a, c - a], axis=2))
    expected = np.zeros(len(nodes))
    for number, row in enumerate(triangles):
        y, z = inverse[number] @ (points - a[number]).T
        x = 1.0 - y - z
        shapes = [x * (2 * x - 1), y * (2 * y - 1), z * (2 * z - 1), 4 * x * y, 4 * y * z, 4 * z * x]
        inside = (np.stack([x, y, z]) >= 0.0).all(axis=0)
        np.add.at(expected, row, np.array(shapes)[:, inside] @ traction[inside])
    np.testing.assert_allclose(weights(nodes, triangles), expected / traction.sum(), atol=1e-3)


@pytest.mark.parametrize("count", [0, 30, 300])
def test_quadratic_footprint_preserves_moments(count: int) -> None:
    """Quadratic functions are integrated exactly on any mesh: linear triangles preserve the first two moments only."""
    nodes, triangles = quadratic_sheet(count)
    weight = weights(nodes, triangles)
    assert weight.sum() == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(weight @ nodes, POINT, atol=2e-3 * RADIUS)
    arm = (nodes - POINT)[:, :2] / RADIUS
    np.testing.assert_allclose(np.einsum("v,vi,vj->ij", weight, arm, arm), np.eye(2) / 5.0, atol=2e-3)


def test_footprint_weights_without_loads_are_empty() -> None:
    nodes, triangles = sheet(30)
    assert compute_footprint_weights(nodes, triangles, np.zeros((0, 3)), np.zeros(0)).shape == (0, len(nodes))


@pytest.mark.parametrize("aspect", [1.0, 1e-3, 1e-6, 1e-10])
def test_nearest_point_agrees_with_sampled_search(aspect: float) -> None:
    """Triangles of every shape, including needles: no sampled point is nearer."""
    rng = np.random.default_rng(5)
    corners = rng.normal(size=(20, 3, 3))
    corners[:, 2] = (corners[:, 0] + corners[:, 1]) / 2.0 + aspect * (corners[:, 2] - corners[:, 0])
    share = rng.dirichlet([0.5, 0.5, 0.5], 4000)
    samples = np.einsum("qc,sci->sqi", share, corners).reshape(-1, 3)
    for point in rng.normal(size=(30, 3)):
        found = find_nearest_point(corners, point)
        best = np.linalg.norm(samples - point, axis=1).min()
        length = np.linalg.norm(found - point)
        assert length <= best + 1e-9
        assert np.linalg.norm(samples - found, axis=1).min() < 0.15  # and it lies on one of them


def test_nearest_point_is_found_in_every_chunk() -> None:
    """Many more triangles than one thread searches; every point lies above its own triangle."""
    nodes, triangles = sheet(400)
    assert len(triangles) > 8 * CHUNK
    above = nodes[triangles].mean(axis=1) + [0.0, 0.0, 1e-3]
    skin = ContactSurface(nodes, triangles, find_device("cpu", "float64"))
    found, distance = skin.find_nearest(above, np.full(len(above), 2e-3))
    np.testing.assert_allclose(found, above * [1.0, 1.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(distance, 1e-3, rtol=1e-12)
    assert np.isinf(skin.find_nearest(above, np.full(len(above), 0.9e-3))[1]).all()


def test_finer_subdivision_changes_footprint_weights_little() -> None:
    """A tool too small for the allowed subdivisions is rejected."""
    nodes, triangles = sheet(60)
    device, point, radius = find_device("cpu", "float64"), np.zeros((1, 3)), np.array([5e-3])
    coarse, fine = (
        ContactSurface(nodes, triangles, device, subdivision=EdgeSubdivision(max_edge_ratio=share))
        .find_footprints(point, radius)
        .to_matrix(len(nodes))
        for share in (0.12, 0.03)
    )
    assert 0.0 < np.abs((coarse - fine).toarray()).max() < 2e-3
    with pytest.raises(InputError, match="too small"):
        ContactSurface(nodes, triangles, device, subdivision=EdgeSubdivision(max_subdivisions=1)).find_footprints(
            point, radius
        )


@pytest.mark.parametrize("mesh", [sheet(300), quadratic_sheet(60)], ids=["linear", "quadratic"])
def test_footprint_centre_is_weighted_mean_of_nodes(mesh: tuple[np.ndarray, np.ndarray]) -> None:
    points, radii = np.array([POINT, [0.03, 0.0, 0.0]]), np.array([RADIUS, 0.007])
    pressed = ContactSurface(*mesh, find_device("cpu", "float64")).find_footprints(points, radii)
    np.testing.assert_allclose(pressed.compute_centres(), pressed.to_matrix(len(mesh[0])) @ mesh[0], atol=1e-16)


def test_footprint_follows_arrays_changed_in_place() -> None:
    nodes, triangles = sheet(300)
    skin, points, radii = (
        ContactSurface(nodes, triangles, find_device("cpu", "float64")),
        POINT[None].copy(),
        np.array([RADIUS]),
    )
    before = skin.find_footprints(points, radii)
    assert skin.find_footprints(points.copy(), radii) is before  # nothing is integrated twice
    points[0, 0] += 0.01
    np.testing.assert_allclose(skin.find_footprints(points, radii).compute_centres(), points, atol=2e-3 * RADIUS)


@pytest.mark.gpu
@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device here")
@pytest.mark.parametrize("mesh", [sheet(3000), quadratic_sheet(300)], ids=["linear", "quadratic"])
def test_cuda_footprint_weights_agree_with_cpu(mesh: tuple[np.ndarray, np.ndarray]) -> None:
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-0.03, 0.03, (200, 2)), rng.uniform(-3e-4, 3e-4, 200)])
    radii = rng.uniform(5e-4, 0.016, 200)
    here, there = (
        ContactSurface(*mesh, find_device(name, "float64")).find_footprints(points, radii) for name in ("cpu", "cuda")
    )
    shares = (one.to_matrix(len(mesh[0])).toarray() for one in (there, here))
    np.testing.assert_allclose(*shares, atol=1e-12)
    np.testing.assert_allclose(there.compute_centres(), here.compute_centres(), atol=1e-14)
