"""Refinement of a mesh without change of the body."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import box as block
from boxes import hold

from sim.bodies.refine import refine
from sim.bodies.subject import MeshPlan, make_anatomy
from sim.bodies.template import Tumour, build_template_subject
from sim.errors import InputError
from sim.geometry.surface import compute_areas, compute_edge_lengths
from sim.geometry.tetmesh import TetMesh, compute_row_keys


def test_refinement_keeps_body_and_halves_every_edge():
    mesh = block((2, 2, 3), 0.1, distortion=0.2)
    mesh = TetMesh(mesh.nodes, mesh.tets, np.arange(len(mesh.tets)) % 3)
    fine = refine(hold(mesh, mesh.nodes[:, 2] < 1e-9)).mesh
    assert len(fine.tets) == 8 * len(mesh.tets)
    np.testing.assert_array_equal(fine.nodes[: len(mesh.nodes)], mesh.nodes)
    assert (fine.volumes > 0.0).all()
    for label in range(3):
        parts = fine.volumes[fine.region == label].reshape(-1, 8)
        np.testing.assert_allclose(parts, np.repeat(mesh.volumes[mesh.region == label, None] / 8.0, 8, axis=1))
    # No gaps: each coarse surface triangle became four, and nothing else is surface.
    assert len(fine.surface) == 4 * len(mesh.surface)
    faces = np.sort(fine.tets[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    assert np.unique(compute_row_keys(faces), return_counts=True)[1].max() == 2


def test_refinement_keeps_held_vertices_and_opening(box):
    fine = refine(box)
    assert fine.fixed[: len(box.mesh.nodes)].tolist() == box.fixed.tolist()
    # Of the finer surface, what lies inside the opening's triangles is open and the rest is held.
    assert len(fine.open_surface) == 4 * len(box.open_surface)
    surface = np.unique(fine.mesh.surface)
    opening = np.unique(fine.open_surface)
    rim = ~fine.fixed[surface].any(axis=1) & ~fine.craniotomy[surface]
    assert fine.craniotomy[opening].all()
    assert not (fine.fixed.any(axis=1) & fine.craniotomy).any()
    # Free and not to be touched: on edges between an open and a held node.
    near = np.abs(np.linalg.norm(fine.mesh.nodes[surface[rim]], axis=1) - 25e-3)
    assert near.max() < 8e-3


def test_refinement_near_opening_divides_only_nearby_cells(box):
    fine = refine(box, near_opening=True)
    mesh, count = fine.mesh, len(box.mesh.nodes)
    np.testing.assert_array_equal(mesh.nodes[:count], box.mesh.nodes)
    assert (mesh.volumes > 0.0).all() and np.isin(np.arange(len(mesh.nodes)), mesh.tets).all()
    for label in np.unique(box.mesh.region):
        whole = box.mesh.volumes[box.mesh.region == label].sum()
        assert mesh.volumes[mesh.region == label].sum() == pytest.approx(whole, rel=1e-12)
    assert len(fine.open_surface) == 4 * len(box.open_surface)
    # Every inner face is of two tetrahedra, and the surface has the area and the closed shape that it had.
    faces = np.sort(mesh.tets[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    times = np.unique(compute_row_keys(faces), return_counts=True)[1]
    assert times.max() == 2 and (times == 1).sum() == len(mesh.surface)
    assert compute_areas(mesh.nodes[mesh.surface]).sum() == pytest.approx(
        compute_areas(box.mesh.nodes[box.mesh.surface]).sum()
    )
    opened = box.mesh.nodes[np.unique(box.open_surface)]
    far = np.linalg.norm(mesh.nodes[count:, None] - opened, axis=2).min(axis=1).max()
    assert far < 2.5 * compute_edge_lengths(box.mesh.nodes[box.open_surface]).mean()
    assert 0 < len(mesh.nodes) - count < 0.5 * (len(refine(box).mesh.nodes) - count)


def test_fine_opening_of_a_mesh_plan_is_refined():
    subject = build_template_subject(Tumour())
    plain, fine = (make_anatomy(subject, MeshPlan(2000, fine_opening=each)) for each in (False, True))
    assert len(fine.open_surface) == 4 * len(plain.open_surface) and fine.digest != plain.digest


def test_fixed_or_sliding_surface_is_not_open(box):
    everywhere = np.isin(np.arange(len(box.mesh.nodes)), box.mesh.surface)
    fine = refine(replace(box, craniotomy=everywhere))
    assert fine.craniotomy.any() and not fine.fixed[fine.craniotomy].any()


def test_refinement_of_quadratic_mesh_is_rejected():
    mesh = TetMesh(np.vstack([np.zeros(3), np.eye(3), _middles()]), [[0, 1, 2, 3]], [0], [[4, 5, 6, 7, 8, 9]])
    with pytest.raises(InputError, match="linear one"):
        refine(hold(mesh, np.ones(10, bool)))


def _middles():
    corner = np.vstack([np.zeros(3), np.eye(3)])
    return [(corner[i] + corner[j]) / 2.0 for i, j in ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))]
