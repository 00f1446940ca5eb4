"""Boundary elements: identities, analytic solutions, convergence to quadratic tetrahedra, rejected bodies."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import box, hold

from sim import REFERENCE, Elasticity, Fem, Held, InputError, Loads, Material, NodalForce
from sim.families.boundary_elements import compute_response
from sim.families.kelvin_integrals import integrate_triangles
from sim.families.linear_body import LinearBody
from sim.geometry.surface import compute_vertex_areas
from sim.geometry.tetmesh import TetMesh
from sim.loads import Nodal

BRAIN, STIFF = (Material("linear", young, 0.45) for young in (3000.0, 30000.0))


def build_block(cells=(4, 4, 4), share=1e-3, tissues=(BRAIN, STIFF), inner=True):
    """A block 0.1 m high, fixed up to `share` of its height, with forces near its top's centre and a tumour inside."""
    mesh = box(cells)
    centre = mesh.nodes[mesh.tets].mean(axis=1)
    mesh = TetMesh(mesh.nodes, mesh.tets, np.where(inner & (np.abs(centre - 0.05) < 0.0251).all(axis=1), 2, 1))
    surface = np.isin(np.arange(len(mesh.nodes)), mesh.surface)
    fixed = surface & (mesh.nodes[:, 2] < 0.1 * share)
    acting = np.flatnonzero(np.linalg.norm(mesh.nodes - [0.05, 0.05, 0.1], axis=1) < 0.03)
    acting = acting[mesh.nodes[acting, 2] > 0.1 - 1e-9]
    lame = {label: tissue.lame for label, tissue in enumerate(tissues, 1)}
    return LinearBody(hold(mesh, fixed), fixed, acting, lame, Elasticity(tissues[0]))


def solve_fem(body, nodes, tissues):
    """Response (a, 3, n, 3) [m/N] of quadratic tetrahedra at small strain."""
    effects = [Elasticity(tissues[0], {2: tissues[1]}), Held(), NodalForce()]
    force = np.zeros((len(body.loaded), 3, len(body.fixed), 3))
    force[np.arange(len(force)), :, body.loaded] = 1e-6 * np.eye(3)
    loads = Loads((Nodal(force.reshape(-1, *force.shape[2:])),))
    moved = Fem(body.anatomy, effects, REFERENCE, "cpu", element="p2").deform(loads, at=nodes)
    return 1e6 * moved.displacement.reshape(len(body.loaded), 3, -1, 3)


def test_boundary_integrals_satisfy_somiglianas_identity() -> None:
    """Somigliana's identity holds for linear displacements inside, at vertices, and 1 mm below the surface."""
    mesh, rng = box((3, 3, 3)), np.random.default_rng(0)
    corners = mesh.nodes[mesh.surface]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    gradient = rng.normal(size=(3, 3))
    mu, lam = BRAIN.lame
    for matrix in (gradient - gradient.T, gradient):
        stress = mu * (matrix + matrix.T) + lam * np.trace(matrix) * np.eye(3)
        for point in (mesh.nodes[0], mesh.nodes[5], np.full(3, 0.04), np.array([0.05, 0.04, 0.099])):
            moved, pulled = integrate_triangles(corners - point, 0.45).swapaxes(0, 1)
            left = np.einsum("skij,skj->i", pulled, (corners - point) @ matrix.T)
            right = np.einsum("skij,sj->i", moved, normal @ stress) / mu
            np.testing.assert_allclose(left, right, atol=2e-6 * lam / mu)
    inside = integrate_triangles(corners - 0.04, 0.45)[:, 1].sum(axis=(0, 1))
    np.testing.assert_allclose(inside, -np.eye(3), atol=1e-5)


def test_integrals_over_small_triangle_agree_with_kelvin() -> None:
    """Displacements as in Kelvin's formula; tractions by Hooke's law from differences of these displacements."""
    mu, lam = BRAIN.lame
    place, corners = np.array([0.03, -0.05, 0.02]), 1e-6 * np.array([[0.0, 0, 0], [3, 1, 0], [1, 2, 3]])
    area_normal = 0.5 * np.cross(corners[1], corners[2])

    def move(at: np.ndarray) -> np.ndarray:
        r = np.linalg.norm(at)
        return ((3.0 - 4.0 * 0.45) * np.eye(3) + np.outer(at, at) / r**2) / (16.0 * np.pi * mu * 0.55 * r)

    moved, pulled = integrate_triangles((place + corners)[None], 0.45)[0].sum(axis=1)
    np.testing.assert_allclose(moved / mu, np.linalg.norm(area_normal) * move(place + corners.mean(axis=0)), rtol=1e-6)
    slope = np.stack([(move(place + h) - move(place - h)) / 2e-6 for h in 1e-6 * np.eye(3)], axis=-1)
    stress = mu * (slope + slope.swapaxes(1, 2)) + lam * np.einsum("ikk,jl->ijl", slope, np.eye(3))
    np.testing.assert_allclose(pulled, stress @ area_normal, rtol=1e-3, atol=1e-4 * np.abs(pulled).max())


def test_bar_under_uniform_traction_stretches_uniformly() -> None:
    """Patch test: strain 1 / E [Pa] under unit traction if lateral contraction vanishes, away from the ends."""
    tissue = Material("linear", 3000.0, 0.0)
    body = build_block((4, 4, 12), tissues=(tissue,), inner=False)
    nodes = body.anatomy.mesh.nodes
    top = np.flatnonzero(nodes[:, 2] > 0.1 - 1e-9)
    upper = body.anatomy.mesh.surface
    force = compute_vertex_areas(nodes, upper[np.isin(upper, top).all(axis=1)])[top]
    moved = np.einsum("a,anj->nj", force, compute_response(replace(body, loaded=top), np.arange(len(nodes)))[:, 2])
    low, high = (np.abs(nodes[:, 2] - level) < 1e-9 for level in (0.2 / 6, 0.4 / 6))
    strain = (moved[high] - moved[low]) / (0.2 / 6)
    np.testing.assert_allclose(strain * tissue.young, np.tile([0.0, 0.0, 1.0], (25, 1)), atol=0.05)


@pytest.mark.parametrize("other", [BRAIN, STIFF])
def test_response_converges_to_quadratic_tetrahedra(other: Material) -> None:
    """Errors at the tumour against the extrapolated limit of quadratic tetrahedra, with one region and with two."""
    tissues, response, expected = (BRAIN, other), [], []
    for cells in (4, 8):
        body = build_block((cells,) * 3, tissues=tissues)
        nodes = body.anatomy.mesh.nodes
        body = replace(body, loaded=np.flatnonzero(np.linalg.norm(nodes - [0.05, 0.05, 0.1], axis=1) < 1e-9))
        at = body.anatomy.tumour_nodes
        at = at[(np.abs(np.rint(nodes[at] / 0.025) - nodes[at] / 0.025) < 1e-6).all(axis=1)]
        response.append(compute_response(body, at))
        expected.append(solve_fem(body, at, tissues))
    limit = expected[1] + (expected[1] - expected[0]) / 3.0
    coarse, fine = (np.linalg.norm(each - limit) / np.linalg.norm(limit) for each in response)
    assert fine < 0.01 and fine < 0.6 * coarse


def test_response_is_nearly_reciprocal() -> None:
    body = build_block((6, 6, 6), share=0.99)
    between = compute_response(body, body.loaded).swapaxes(1, 2)
    apart = ~np.eye(len(body.loaded), dtype=bool)
    difference = between - between.transpose(1, 0, 3, 2)
    assert 0.0 < np.linalg.norm(difference[apart]) < 0.05 * np.linalg.norm(between[apart])


def test_response_of_nearly_incompressible_pieces_is_finite() -> None:
    """A tumour in two pieces, one of which reaches the free surface."""
    body = build_block(tissues=(Material("linear", 3000.0, 0.4995), Material("linear", 9000.0, 0.4995)))
    mesh = body.anatomy.mesh
    centre = mesh.nodes[mesh.tets].mean(axis=1)
    pieces = (np.abs(centre - [0.0625, 0.0625, 0.0875]) < 0.0125) | (np.abs(centre - [0.0375, 0.0375, 0.0375]) < 0.0125)
    mesh = TetMesh(mesh.nodes, mesh.tets, np.where(pieces.all(axis=1), 2, 1))
    response = compute_response(replace(body, anatomy=hold(mesh, body.fixed)), np.arange(len(mesh.nodes)))
    assert np.isfinite(response).all() and (response[:, :, body.fixed] == 0.0).all()
    work = np.einsum("aiai->a", response[:, :, body.loaded])
    assert (work > 0.0).all() and work.max() < 2.0 * work.min()


def test_boundary_elements_reject_unsupported_bodies() -> None:
    body = build_block()
    mesh = body.anatomy.mesh
    middle = np.linalg.norm(mesh.nodes - 0.05, axis=1) < 1e-9
    beside = np.linalg.norm(mesh.nodes - [0.05, 0.05, 0.025], axis=1) < 1e-9
    oedema = TetMesh(mesh.nodes, mesh.tets, np.where(np.arange(len(mesh.tets)) < 6, 3, mesh.region))
    for other, message in (
        (replace(body, anatomy=hold(oedema, body.fixed), lame={**body.lame, 3: (1.0, 1.0)}), "different tissues"),
        (replace(body, fixed=body.fixed | middle), "fixed inside the body"),
        (replace(body, fixed=body.fixed & False), "no surface triangle"),
        (replace(body, loaded=np.flatnonzero(beside)), "acting has"),
        (replace(body, loaded=np.repeat(body.loaded[:1], 2)), "acting has"),
        (replace(body, loaded=np.flatnonzero(body.fixed)[:1]), "acting has"),
    ):
        with pytest.raises(InputError, match=message):
            compute_response(other, body.loaded)
