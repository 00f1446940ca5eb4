"""Mid-edge nodes: their constraints and normals by brute force; results contain vertices only."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from boxes import VTK_EDGES, base_held, box, hold, integrate_surface_normals, quadratic

from sim.accuracy import Accuracy
from sim.compile import compile_problem
from sim.discretisation.space import Discretisation, discretise
from sim.effects import Elasticity, Held, NodalForce, ToolForce
from sim.errors import InputError
from sim.fem import MID_EDGE_KEY, Fem
from sim.geometry.tetmesh import TetMesh
from sim.loads import push
from sim.runtime.device import find_device

TIGHT = Accuracy(tolerance=1e-10)
FACING = 0.75
THIN = box((3, 3, 1), 0.1)
"""One cell thick: many edges inside join two surface nodes."""
CUBE = box((3, 3, 3), 0.1)
ARM = CUBE.nodes - 0.05
LENGTH = np.maximum(np.linalg.norm(ARM, axis=1, keepdims=True), 1e-9)
ROUND = replace(CUBE, nodes=ARM * np.abs(ARM).max(axis=1, keepdims=True) / LENGTH)
"""A cube drawn into a ball: no three of its surface nodes in line."""


def triangles_round(mesh: TetMesh, ends: np.ndarray) -> list[list[int]]:
    """The surface triangles that have the edge with these ends."""
    return [list(corners) for corners in mesh.surface.tolist() if set(ends.tolist()) <= set(corners)]


def test_every_edge_has_one_node_at_its_midpoint() -> None:
    space = discretise(THIN, "p2")
    edges = {pair for tet in THIN.tets.tolist() for pair in combinations(sorted(tet), 2)}
    assert sorted(edges) == sorted(map(tuple, space.edges.tolist()))
    assert space.count == len(THIN.nodes) + len(edges)
    np.testing.assert_array_equal(space.nodes[: len(THIN.nodes)], THIN.nodes)
    np.testing.assert_allclose(space.nodes[space.table[:, 4:]], THIN.nodes[THIN.tets[:, VTK_EDGES]].mean(axis=2))
    a, b, c = np.moveaxis(space.nodes[space.surface[:, :3]], 1, 0)
    halves = np.stack([(a + b) / 2.0, (b + c) / 2.0, (c + a) / 2.0], axis=1)
    np.testing.assert_allclose(space.nodes[space.surface[:, 3:]], halves)
    np.testing.assert_array_equal(space.surface[:, :3], THIN.surface)


def test_corner_interpolation_is_exact_for_linear_fields() -> None:
    for space in (discretise(THIN, "p2"), discretise(quadratic(THIN), "p2")):
        carried = space.corner_interpolation @ space.nodes[np.unique(space.table[:, :4])]
        np.testing.assert_allclose(carried, space.nodes, atol=1e-16)


def test_added_mid_edge_node_is_held_with_its_triangle() -> None:
    """Component by component; not where two held nodes are joined through the body."""
    held = np.random.default_rng(0).uniform(size=THIN.nodes.shape) < 0.8
    space = discretise(THIN, "p2")
    found = space.extend_fixed(held)
    np.testing.assert_array_equal(found[: len(held)], held)
    expected = np.array(
        [np.any([held[t].all(axis=0) for t in triangles_round(THIN, e)] or [[False] * 3], axis=0) for e in space.edges]
    )
    np.testing.assert_array_equal(found[len(held) :], expected)
    both = held[space.edges].all(axis=1)
    assert (both & ~expected).sum() > 20
    assert expected.sum() > 20


def test_mid_edge_nodes_of_the_mesh_keep_their_constraints() -> None:
    mesh = quadratic(THIN)
    held = np.zeros((len(mesh.nodes), 3), bool)
    held[np.unique(mesh.tets)] = True
    np.testing.assert_array_equal(discretise(mesh, "p2").extend_fixed(held), held)


def sliding() -> tuple[Discretisation, np.ndarray, np.ndarray, np.ndarray]:
    """A ball with some nodes held, some sliding, some free; normals of the mesh's own nodes, then of all."""
    kind = np.random.default_rng(1).choice(3, len(ROUND.nodes), p=[0.1, 0.2, 0.7])
    surface = np.zeros(len(ROUND.nodes), bool)
    surface[ROUND.surface] = True
    held = np.repeat((surface & (kind == 1))[:, None], 3, axis=1)
    normal = np.where((surface & (kind == 2))[:, None], ARM / LENGTH, 0.0)
    space = discretise(ROUND, "p2")
    return space, held, normal, space.extend_normals(normal, held, FACING)


def test_added_mid_edge_node_slides_along_its_triangles() -> None:
    """Brute force over edges: along all triangles where they face as its ends do, else along those of the wall."""
    space, held, normal, found = sliding()
    np.testing.assert_array_equal(found[: len(normal)], normal)
    slides = (normal != 0.0).any(axis=1)
    between_held = astray = 0
    for edge, got in zip(space.edges, found[len(normal) :], strict=True):
        walls = [
            triangle
            for triangle in triangles_round(ROUND, edge)
            if (slides | held.all(axis=1))[triangle].all() and slides[triangle].any()
        ]
        between_held += not slides[edge].any() and len(walls)
        corners = ROUND.nodes[triangles_round(ROUND, edge)].reshape(-1, 3, 3)
        expected = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(axis=0)
        if (normal[edge][slides[edge]] @ expected <= FACING * np.linalg.norm(expected)).any():
            astray += 1
            corners = ROUND.nodes[walls].reshape(-1, 3, 3)
            expected = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(axis=0)
        expected = expected / np.linalg.norm(expected) if walls else np.zeros(3)
        np.testing.assert_allclose(got, expected, atol=1e-12)
    many = (found[len(normal) :] != 0.0).any(axis=1).sum()
    assert 20 < many < len(space.edges)
    assert between_held and 0 < astray < many


def test_sliding_normals_of_ball_are_parallel_to_flux_vectors() -> None:
    """Normals are parallel to the flux vector of their node, and as radial as its triangles allow."""
    surface = np.zeros(len(ROUND.nodes), bool)
    surface[ROUND.surface] = True
    space = discretise(ROUND, "p2")
    found = space.extend_normals(np.where(surface[:, None], ARM / LENGTH, 0.0), np.zeros((len(surface), 3), bool))
    wall = np.unique(space.surface)
    radial = space.nodes / np.maximum(np.linalg.norm(space.nodes, axis=1, keepdims=True), 1e-9)
    assert (np.einsum("ni,ni->n", found[wall], radial[wall]) > np.cos(np.radians(20.0))).all()
    middles = wall[wall >= len(ROUND.nodes)]
    swept = integrate_surface_normals(space.nodes, space.surface)
    np.testing.assert_allclose(np.cross(found, swept)[middles], 0.0, atol=1e-12)
    assert not np.delete(found, wall, axis=0).any()


def test_box_face_slides_in_its_plane_next_to_an_edge() -> None:
    """Nodes on an edge have one normal between two planes, or slide in one and have a component held."""
    x, y = THIN.nodes[:, 0] == 0.0, THIN.nodes[:, 1] == 0.0
    for bound in (False, True):
        normal = np.where(x[:, None], [-1.0, 0.0, 0.0], 0.0) + np.where(y[:, None], [0.0, -1.0, 0.0], 0.0)
        normal[x & y] = [-1.0, 0.0, 0.0] if bound else [-np.sqrt(0.5), -np.sqrt(0.5), 0.0]
        held = np.zeros(normal.shape, bool)
        held[x & y, 1] = bound
        space = discretise(THIN, "p2")
        found = space.extend_normals(normal, held)[len(normal) :]
        middle = space.nodes[len(normal) :]
        on_x, on_y = middle[:, 0] == 0.0, middle[:, 1] == 0.0
        for face, axis in ((on_x & ~on_y, 0), (on_y & ~on_x, 1)):
            sliding = face & (found != 0.0).any(axis=1)
            assert sliding.sum() > 5
            np.testing.assert_allclose(np.abs(found[sliding][:, axis]), 1.0)


@pytest.fixture(scope="module")
def fem() -> Fem:
    return Fem(base_held(THIN), [Elasticity(), Held(), NodalForce(), ToolForce()], TIGHT, "cpu", element="p2")


def test_deformation_has_rows_of_mesh_vertices_only(fem: Fem) -> None:
    found = fem.deform(push([0.05, 0.05, 0.1 / 3.0], [[0.0, 0.0, -0.3], [0.0, 0.1, 0.0]], 0.02))
    assert found.displacement.shape == (2, len(THIN.nodes), 3)
    np.testing.assert_array_equal(found.nodes, np.arange(len(THIN.nodes)))
    assert found.memory[MID_EDGE_KEY].shape == (2, len(fem.space.edges), 3)
    assert np.abs(found.memory[MID_EDGE_KEY]).max() > 1e-5
    assert fem.deform(
        push([0.05, 0.05, 0.1 / 3.0], [0.0, 0.0, -0.3], 0.02), at=np.array([7, 3])
    ).displacement.shape == (1, 2, 3)


def test_start_without_mid_edge_nodes_is_accepted(fem: Fem) -> None:
    """From elements without them: they begin in the middle between their ends."""
    loads = push([0.05, 0.05, 0.1 / 3.0], [0.0, 0.0, -0.3], 0.02)
    found = fem.deform(loads)
    bare = fem.deform(loads, replace(found, memory={}))
    assert bare.iterations[0] > 0
    np.testing.assert_allclose(bare.displacement, found.displacement, atol=1e-9)


def test_start_is_split_into_the_same_batches_as_loads() -> None:
    """Mid-edge nodes of every row are passed on: the solution as start needs no iteration."""
    fem = Fem(base_held(THIN), [Elasticity(), Held(), ToolForce()], TIGHT, "cpu", batch=2, element="p2")
    loads = push([0.05, 0.05, 0.1 / 3.0], np.outer([0.1, -0.2, 0.3, 0.2, -0.1], [0.3, 0.1, -1.0]), 0.02)
    np.testing.assert_array_equal(fem.deform(loads, fem.deform(loads)).iterations, 0)


ONE = TetMesh(0.1 * np.vstack([np.zeros(3), np.eye(3)]), np.array([[0, 1, 2, 3]]), np.zeros(1, int))
TWO = quadratic(box((1, 1, 1), 0.1))
assert TWO.middles is not None


@pytest.mark.parametrize(
    ("mesh", "middles", "sentence"),
    [
        (quadratic(ONE), [[4, 5, 6, 7, 8]], r"middles have shape \(1, 5\): give six"),
        (quadratic(ONE), [[4, 5, 6, 7, 8, 10]], "outside the mesh's, 0 to 9"),
        (quadratic(ONE), [[4, 5, 6, 7, 8, -1]], "outside the mesh's"),
        (quadratic(ONE), [[4, 5, 6, 7, 8, 0]], "node 0 is a corner and the middle of an edge at once"),
        (quadratic(ONE), [[4, 5, 6, 7, 8, 8]], "does not conform"),
        (TWO, np.where(np.arange(6)[:, None] == 2, TWO.middles[:, [1, 0, 2, 3, 4, 5]], TWO.middles), "disagree"),
    ],
)
def test_invalid_mid_edge_nodes_are_rejected(mesh: TetMesh, middles: np.ndarray, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        replace(mesh, middles=np.array(middles))


def test_elements_that_do_not_fit_the_mesh_are_rejected() -> None:
    for element in ("p1", "smoothed"):
        with pytest.raises(InputError, match=f"quadratic tetrahedra, not {element}: use p2"):
            discretise(quadratic(ONE), element)
    with pytest.raises(InputError, match="no element is called 'q1': choose one of p1, p2, smoothed"):
        discretise(ONE, "q1")


def test_elements_folded_by_mid_edge_nodes_are_rejected() -> None:
    mesh = quadratic(ONE)
    nodes = mesh.nodes.copy()
    nodes[4] = nodes[[0, 1]].mean(axis=0) + [0.04, 0.0, 0.0]  # past the quarter point
    body = hold(replace(mesh, nodes=nodes), np.ones(10, bool))
    with pytest.raises(InputError, match=r"tetrahedron 0 .*folded over by its mid-edge nodes"):
        compile_problem([Elasticity(), Held()], body, find_device("cpu", "float64"), discretise(body.mesh, "p2"))
