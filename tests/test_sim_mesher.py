"""Meshes of rough tumours and cortices: fitted, or rejected with a remedy."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from test_sim_label_volume import AFFINES, AXES, MIDDLE, RADIUS, ball, grid, labelled, save, with_plates

from sim.anatomy import TUMOUR_LABEL
from sim.bodies import mesher
from sim.bodies.label_volume import build_volume_subject
from sim.bodies.subject import MeshPlan, make_anatomy
from sim.errors import InputError
from sim.geometry.tetmesh import compute_dihedral_angles


def roughness(shape, amount, width, seed):
    """Random field of that standard deviation, smooth over `width` voxels."""
    noise = gaussian_filter(np.random.default_rng(seed).standard_normal(shape), width)
    return amount * noise / noise.std()


def rough_tumour(amount, width, seed=1):
    return lambda points: ball(points, radius=RADIUS * (1.2 + roughness(points.shape[:-1], amount, width, seed)))


def test_rough_cortex_is_meshed(tmp_path, monkeypatch):
    """A mesh fitted to the rough cortex folds, so that the nodes of folds are not moved."""
    affine, places = grid(AFFINES["straight"])
    rough = np.linalg.norm((places - MIDDLE) / AXES, axis=-1) < 0.9 + roughness(places.shape[:-1], 0.15, 2.0, 1)
    labels = np.where(ball(places), 3, rough)
    subject = build_volume_subject(save(tmp_path / "l.nii", labels, affine), (1,), (3,))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = make_anatomy(subject, MeshPlan(nodes=2000)).mesh
    assert compute_dihedral_angles(mesh.nodes, mesh.tets).min() > 10.0
    assert mesh.volumes[mesh.region == TUMOUR_LABEL].sum() == pytest.approx(subject.tumour_volume, rel=0.02)
    monkeypatch.setattr(mesher, "prevent_folds", lambda nodes, moved, tets: moved)
    with pytest.raises(InputError, match="too intricate for 2000 nodes"):
        make_anatomy(subject, MeshPlan(nodes=2000, meshing=mesher.Meshing(factors=())))


def test_fit_without_folds_is_not_corrected(tmp_path, monkeypatch):
    path, _, _ = labelled(tmp_path / "l.nii", AFFINES["straight"])
    monkeypatch.delattr(mesher, "prevent_folds")
    assert len(make_anatomy(build_volume_subject(path, (1, 2), (3, 4)), MeshPlan(nodes=2000)).mesh.nodes)


def test_mesh_without_tumour_detail_names_needed_nodes(tmp_path):
    path, _, _ = labelled(tmp_path / "l.nii", AFFINES["straight"], rough_tumour(0.6, 2.0))
    subject, plan = build_volume_subject(path, (1, 2), (3, 4)), MeshPlan(nodes=2000)
    with pytest.raises(InputError, match="too intricate for 2000 nodes: ask for") as caught:
        make_anatomy(subject, plan)
    enough = int(re.search(r"ask for (\d+)", str(caught.value))[1])

    def missed(nodes, most):
        mesh = make_anatomy(subject, replace(plan, nodes=nodes, meshing=mesher.Meshing(max_volume_error=most))).mesh
        return 1.0 - mesh.volumes[mesh.region == TUMOUR_LABEL].sum() / subject.tumour_volume

    assert missed(2000, 1.0) > 0.1 > abs(missed(enough, 0.1))


def test_too_small_tumour_pieces_are_reported(tmp_path):
    subject = build_volume_subject(with_plates(tmp_path / "l.nii", 12), (1,), (3,))
    with pytest.raises(
        InputError, match=r"12 of the tumour's 13 pieces, 1.\d ml in all, are too small for 2000 nodes: "
    ):
        make_anatomy(subject, MeshPlan(nodes=2000, meshing=mesher.Meshing(factors=())))


def test_too_rough_labels_are_rejected_with_advice_to_smooth(tmp_path):
    path, _, _ = labelled(tmp_path / "l.nii", AFFINES["straight"], rough_tumour(1.5, 1.2))
    plan = MeshPlan(nodes=2000, meshing=mesher.Meshing(factors=(1.25,)))
    with pytest.raises(InputError, match="too intricate for 2000 nodes: smooth the labels"):
        make_anatomy(build_volume_subject(path, (1, 2), (3, 4)), plan)
