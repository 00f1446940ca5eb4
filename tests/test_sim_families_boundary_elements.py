"""Boundary elements: identities, analytic solutions, convergence to quadratic tetrahedra, rejected bodies."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import box, hold

from sim import REFERENCE, Elasticity, Fem, Held, InputError, Loads, Material, NodalForce
from sim.families.boundary_elements import compute_response
from sim.families.kelvin_integrals import integrate_triangles
from sim.families.linear_body import Body
from sim.geometry.surface import compute_vertex_areas
from sim.geometry.tetmesh import TetMesh
from sim.loads import Nodal

BRAIN = Material("linear", 3000.0, 0.45)


def build_block(cells=4, tumour=True, share=1.0, tissues=(BRAIN, Material("linear", 30000.0, 0.45))):
    """A cube of 0.1 m, fixed up to `share` of its height except at the top, with a cube as its tumour."""
    mesh = box((cells,) * 3)
    centre = mesh.nodes[mesh.tets].mean(axis=1)
    region = np.where(tumour & (np.abs(centre - 0.05) < 0.0251).all(axis=1), 2, 1)
    mesh = TetMesh(mesh.nodes, mesh.tets, region)
    surface = np.isin(np.arange(len(mesh.nodes)), mesh.surface)
    fixed = surface & (mesh.nodes[:, 2] < 0.1 * share - 1e-9)
    acting = np.flatnonzero(surface & ~fixed & (np.abs(mesh.nodes[:, :2] - 0.05) < 0.026).all(axis=1))
    return Body(hold(mesh, fixed), fixed, acting, {label: tissue.lame for label, tissue in enumerate(tissues, 1)})


def solve_fem(body, nodes, tissues):
    """Response (a, 3, n, 3) [m/N] of quadratic tetrahedra at small strain."""
    effects = [Elasticity(tissues[0], {2: tissues[1]}), Held(), NodalForce()]
    force = np.zeros((len(body.acting), 3, len(body.fixed), 3))
    for load, vertex in enumerate(body.acting):
        force[load, :, vertex] = 1e-6 * np.eye(3)
    loads = Loads((Nodal(force.reshape(-1, *force.shape[2:])),))
    moved = Fem(body.anatomy, effects, REFERENCE, "cpu", element="p2").deform(loads, at=nodes)
    return 1e6 * moved.displacement.reshape(len(body.acting), 3, -1, 3)


def test_integrals_of_rigid_and_uniform_fields() -> None:
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
            sides = (
                np.einsum("skij,skj->i", pulled, (corners - point) @ matrix.T),
                np.einsum("skij,sj->i", moved, normal @ stress) / mu,
            )
            np.testing.assert_allclose(*sides, atol=2e-5 * 0.1 * np.abs(stress).max() / mu)
    inside = integrate_triangles(corners - 0.04, 0.45)[:, 1].sum(axis=(0, 1))
    np.testing.assert_allclose(inside, -np.eye(3), atol=1e-5)


def test_block_under_uniform_pull_stretches_uniformly() -> None:
    """The patch test: E [Pa] and cross-section give the elongation, if lateral contraction vanishes."""
    tissue = Material("linear", 3000.0, 0.0)
    body = build_block(3, tumour=False, share=1e-3, tissues=(tissue,))
    mesh = body.anatomy.mesh
    top = np.flatnonzero(mesh.nodes[:, 2] > 0.1 - 1e-9)
    upper = mesh.surface[np.isin(mesh.surface, top).all(axis=1)]
    force = compute_vertex_areas(mesh.nodes, upper)
    nodes = np.arange(len(mesh.nodes))
    moved = np.einsum("a,anj->nj", force[top], compute_response(replace(body, acting=top), nodes)[:, 2])
    np.testing.assert_allclose(moved, mesh.nodes[:, 2:] / tissue.young * [0.0, 0.0, 1.0], atol=0.03 * 0.1 / 3000.0)


def test_unit_force_looks_like_boussinesq_far_away() -> None:
    """Boussinesq: a normal force on a half-space moves the axis by F (2 (1 - nu) + 1) (1 + nu) / (2 pi E z)..."""


@pytest.mark.parametrize("factor", [1.0, 10.0])
def test_response_converges_to_quadratic_tetrahedra(factor: float) -> None:
    tissues = BRAIN, Material("linear", factor * BRAIN.young, BRAIN.poisson)
    errors = []
    for cells in (4, 8):
        body = build_block(cells, tissues=tissues)
        body = replace(body, acting=np.array([np.flatnonzero(np.linalg.norm(body.anatomy.mesh.nodes - [0.05, 0.05, 0.1], axis=1) < 1e-9)[0]]))
        nodes = body.anatomy.tumour_nodes
        response, expected = compute_response(body, nodes), solve_fem(body, nodes, tissues)
        errors.append(np.linalg.norm(response - expected) / np.linalg.norm(expected))
    print(errors)
    assert errors[1] < 0.02


def test_response_is_nearly_reciprocal() -> None:
    body = build_block(6)
    between = compute_response(body, body.acting)
    apart = ~np.eye(len(body.acting), dtype=bool)
    difference = (between - between.transpose(2, 3, 0, 1)).transpose(0, 2, 1, 3)[apart]
    print(np.linalg.norm(difference) / np.linalg.norm(between.transpose(0, 2, 1, 3)[apart]))
    assert np.linalg.norm(difference) < 0.02 * np.linalg.norm(between.transpose(0, 2, 1, 3)[apart])


def test_nearly_incompressible_tissue_and_pieces_are_finite() -> None:
    """A tumour in two pieces, one of which reaches the free surface."""
    body = build_block(4, tissues=(Material("linear", 3000.0, 0.4995), Material("linear", 9000.0, 0.4995)))
    mesh = body.anatomy.mesh
    region = mesh.region.copy()
    region[(mesh.nodes[mesh.tets].mean(axis=1) > [0.05, 0.05, 0.076]).all(axis=1) & (mesh.nodes[mesh.tets].mean(axis=1) < [0.075, 0.075, 1.0]).all(axis=1)] = 2
    region[mesh.nodes[mesh.tets].mean(axis=1)[:, 2] < 0.05] = 1
    mesh = TetMesh(mesh.nodes, mesh.tets, region)
    response = compute_response(replace(body, anatomy=hold(mesh, body.fixed)), np.arange(len(mesh.nodes)))
    assert np.isfinite(response).all() and (response[:, :, body.fixed] == 0.0).all()


def test_rejected_bodies() -> None:
    body = build_block(4)
    mesh = body.anatomy.mesh
    middle = np.linalg.norm(mesh.nodes - 0.05, axis=1) < 1e-9
    beside = np.linalg.norm(mesh.nodes - [0.05, 0.05, 0.025], axis=1) < 1e-9
    oedema = TetMesh(mesh.nodes, mesh.tets, np.where(np.arange(len(mesh.tets)) < 6, 3, mesh.region))
    for other, message in (
        (replace(body, anatomy=hold(oedema, body.fixed), lame={**body.lame, 3: (1.0, 1.0)}), "different tissues"),
        (replace(body, fixed=body.fixed | middle), "fixed inside the body"),
        (replace(body, fixed=body.fixed & False), "no surface triangle"),
        (replace(body, acting=np.flatnonzero(beside)), "acting has"),
        (replace(body, acting=np.repeat(body.acting[:1], 2)), "acting has"),
        (replace(body, acting=np.flatnonzero(body.fixed)[:1]), "acting has"),
    ):
        with pytest.raises(InputError, match=message):
            compute_response(other, body.acting)
