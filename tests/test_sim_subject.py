"""Subjects from labels: meshes of tumours, components, holes and rough surfaces."""

import numpy as np
import pytest
from scipy.spatial import KDTree
from test_sim_label_volume import AFFINES, AXES, MIDDLE, RADIUS, TUMOUR, ball, ellipsoid, grid, labelled, save

from sim.anatomy import TUMOUR_LABEL
from sim.bodies.label_volume import build_volume_subject
from sim.bodies.subject import MeshPlan, make_anatomy
from sim.geometry.tetmesh import compute_dihedral_angles


def test_equal_label_volumes_give_equal_anatomies(tmp_path):
    path, _, _ = labelled(tmp_path / "labels.nii", AFFINES["oblique"])
    first, second = (make_anatomy(build_volume_subject(path, (1, 2), (3, 4)), MeshPlan(nodes=2000)) for _ in range(2))
    assert first.digest == second.digest


@pytest.mark.parametrize("rise", [-0.001, 0.006, 0.014])
def test_tumour_at_or_through_the_cortex_is_meshed(tmp_path, rise):
    middle = MIDDLE + [0.0, 0.0, AXES[2] - RADIUS + rise]
    path, labels, affine = labelled(tmp_path / "l.nii", AFFINES["straight"], lambda points: ball(points, middle))
    voxel = 1e-9 * abs(np.linalg.det(affine[:3, :3]))
    anatomy = make_anatomy(build_volume_subject(path, (1, 2), (3, 4)), MeshPlan(nodes=4000))
    mesh = anatomy.mesh
    assert compute_dihedral_angles(mesh.nodes, mesh.tets).min() > 5.0
    assert mesh.volumes[mesh.region == TUMOUR_LABEL].sum() == pytest.approx((labels > 2).sum() * voxel, rel=0.02)
    assert mesh.volumes.sum() == pytest.approx((labels > 0).sum() * voxel, rel=0.01)
    touching = np.intersect1d(np.unique(mesh.surface), anatomy.tumour_nodes)
    assert len(touching) > 3 or rise < 0.0


def test_tumour_components_are_meshed_and_defects_are_noted(tmp_path):
    affine, places = grid(AFFINES["straight"])
    labels = np.where(ellipsoid(places), 1, 0)
    labels[ball(places)] = 3
    second = MIDDLE - [0.018, 0.0, 0.014]
    labels[ball(places, second, 0.007)] = 4
    labels[ball(places, MIDDLE - [0.0, 0.025, 0.0], 0.006)] = 0  # a ventricle
    labels[:4, :4, :4] = 1  # a speck of brain
    labels[-4:, -4:, -4:] = 3  # a speck of tumour, outside
    labels[tuple(np.array(labels.shape) // 2 + [0, 12, 0])] = 3  # one voxel, inside
    subject = build_volume_subject(save(tmp_path / "l.nii", labels, affine), (1,), (3, 4))
    text = " ".join(subject.notes)
    for part in ("of brain that is not connected", "of holes", "of tumour outside", "of tumour in specks"):
        assert part in text
    assert subject.tumour_volume == pytest.approx(sum(piece.volume for piece in subject.pieces))
    anatomy = make_anatomy(subject, MeshPlan(nodes=4000))
    inside = anatomy.mesh.nodes[anatomy.tumour_nodes]
    assert KDTree(inside).query(np.stack([TUMOUR, second]))[0].max() < 0.006
    wanted = 4 / 3 * np.pi * (RADIUS**3 + 0.007**3)
    mesh = anatomy.mesh
    assert mesh.volumes[mesh.region == TUMOUR_LABEL].sum() == pytest.approx(wanted, rel=0.02)
    assert mesh.volumes.sum() == pytest.approx(4 / 3 * np.pi * AXES.prod(), rel=0.01)
