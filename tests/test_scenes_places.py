"""Accuracy of a warp: error by part, grid spacing and folds of FEM."""

import json
from dataclasses import replace

import numpy as np
import pytest

from scenes.cli import main
from scenes.warp.deformed_anatomy import DeformationCause, DeformedAnatomy
from scenes.warp.landmarks import list_landmarks
from scenes.warp.places import MIN_SPACING, SpacingSettings, compute_fields, find_finer_spacing, find_folds, list_points
from sim.anatomy import NECROSIS_LABEL, TUMOUR_LABEL
from sim.bodies.meshfile import write_anatomy, write_mesh
from sim.errors import InputError
from sim.fields.warp_fields import build_warp_grid, compute_warp_fields
from sim.geometry.tetmesh import compute_signed_volumes


def choose_moment(body, displacement):
    return DeformedAnatomy(DeformationCause("a test", {}), body, body, displacement)


@pytest.fixture(scope="module")
def kinked(small_box):
    """One vertex of the tumour goes 2.6 mm aside; its neighbours, 6 mm away, stay."""
    moved = np.zeros_like(small_box.mesh.nodes)
    moved[small_box.tumour_nodes[0]] = [0.0, 2.6e-3, 0.0]
    return choose_moment(small_box, moved)


@pytest.fixture(scope="module")
def fields(kinked):
    return compute_warp_fields(kinked.anatomy, kinked.displacement, 2e-3)


def test_part_error_is_the_larger_of_both_field_errors(kinked, fields):
    places = list_points(kinked)
    errors = places.compute_errors(fields)
    assert 0.05e-3 < errors[places.tumour].max() < 1e-3 and errors[places.cortex].max() < 1e-6
    # No field reaches beyond the grid.
    index = fields.grid.to_indices(places.rest)
    inside = ((index > 0.0) & (index < np.array(fields.grid.shape) - 1)).all(axis=1)
    exact = inside & (errors < 1e-6)
    assert exact.sum() > 20 and not inside[places.cortex].any()
    for name in ("forward", "backward"):
        off = replace(fields, **{name: getattr(fields, name) + np.float32(1e-3)})
        assert np.allclose(places.compute_errors(off)[exact], 3**0.5 * 1e-3, rtol=1e-3)
        assert np.allclose(places.compute_errors(off)[places.cortex], errors[places.cortex])
    assert places.cortex.sum() == len(np.unique(kinked.anatomy.open_surface)) + 3 * len(kinked.anatomy.open_surface)
    assert places.tumour.sum() > 4 * (kinked.anatomy.mesh.region == 2).sum()


def test_tumour_places_include_necrosis(kinked):
    """Half of the tumour's tetrahedra are necrosis."""
    mesh = kinked.anatomy.mesh
    region = mesh.region.copy()
    region[np.flatnonzero(region == TUMOUR_LABEL)[::2]] = NECROSIS_LABEL
    body = replace(kinked.anatomy, mesh=replace(mesh, region=region))
    assert np.array_equal(list_points(choose_moment(body, kinked.displacement)).tumour, list_points(kinked).tumour)


def test_finer_spacing_follows_from_the_tumour_error(kinked, fields):
    finer = find_finer_spacing(kinked, fields)
    assert MIN_SPACING <= finer < fields.grid.spacing
    assert find_finer_spacing(kinked, fields, SpacingSettings(tolerance=1.0)) is None
    found = compute_fields(kinked, None, lambda more: None)
    places = list_points(kinked)
    worst = places.compute_errors(found)[places.tumour].max()
    assert worst <= SpacingSettings().tolerance and found.grid.spacing < 1e-3
    assert find_finer_spacing(kinked, found) is None
    still = choose_moment(kinked.anatomy, 1e-2 * kinked.displacement)
    assert compute_fields(still, None, lambda more: None).grid.spacing == 1e-3


@pytest.fixture(scope="module")
def dented(small_box):
    """The open cortex's landmark goes 4.5 mm inwards, its neighbours, 6 mm away, stay; and the tumour."""
    mesh, (_, mark) = small_box.mesh, list_landmarks(small_box, np.zeros_like(small_box.mesh.nodes))
    moved = np.zeros_like(mesh.nodes)
    moved[np.linalg.norm(mesh.nodes - mark.rest, axis=1).argmin()] = [0.0, 0.0, -4.5e-3]
    return choose_moment(small_box, moved)


def test_dented_cortex_is_fitted_with_points_outside_the_mesh(dented):
    """With points inside tetrahedra alone the cortex has an error of 0.9 mm."""
    fields = compute_warp_fields(dented.anatomy, dented.displacement, 1.5e-3)
    places = list_points(dented)
    errors = places.compute_errors(fields)
    assert places.landmarks.sum() == 2 and not fields.has_folds
    assert errors[places.cortex].max() < 0.2e-3 and errors[places.landmarks].max() < 0.1e-3


def test_finer_spacing_follows_from_the_landmark_error(dented):
    fields = compute_warp_fields(dented.anatomy, dented.displacement, 1.5e-3)
    places = list_points(dented)
    assert places.compute_errors(fields)[places.tumour].max() < SpacingSettings().tolerance / 10.0
    finer = find_finer_spacing(dented, fields)
    assert finer is not None and finer < 1.5e-3


def test_folds_of_fem_are_found_and_sorted_by_size(small_box):
    """Two inner vertices pass through a face of their tetrahedron, one of them barely."""
    mesh, moved = small_box.mesh, np.zeros_like(small_box.mesh.nodes)
    inner = np.setdiff1d(np.arange(len(mesh.nodes)), mesh.surface)
    first, last = inner[0], inner[-1]
    for vertex, times in ((first, 1.0001), (last, 2.0)):
        tet = mesh.tets[(mesh.tets == vertex).any(axis=1)][0]
        moved[vertex] = times * (mesh.nodes[tet[tet != vertex]].mean(axis=0) - mesh.nodes[vertex])
    moment = choose_moment(small_box, moved)
    folds = find_folds(moment, compute_warp_fields(small_box, moved, 2e-3))
    assert len(folds) == 2 and folds[0].volume >= folds[1].volume and folds[0].tetrahedra > folds[1].tetrahedra
    assert all(fold.field_error > 0.1e-3 for fold in folds)


def test_spacing_with_too_many_grid_nodes_is_rejected(small_box):
    with pytest.raises(InputError, match="million are the most"):
        compute_fields(choose_moment(small_box, np.full_like(small_box.mesh.nodes, 40e-3)), 0.3e-3, lambda more: None)


def test_fields_avoid_folds_of_fem_and_report_them(small_box, tmp_path, capsys):
    mesh = small_box.mesh
    middle = mesh.nodes.mean(axis=0)
    vertex = int(np.linalg.norm(mesh.nodes - middle, axis=1).argmin())
    moved = np.zeros_like(mesh.nodes)
    moved[vertex] = [6.5e-3, 1e-3, 0.0]  # past its neighbours, 6 mm away
    bad = compute_signed_volumes(mesh.nodes + moved, mesh.tets) <= 0.0
    moment = choose_moment(small_box, moved)
    fields = compute_warp_fields(small_box, moved, 2e-3)
    (fold,) = find_folds(moment, fields)
    assert not fields.has_folds and fields.min_determinants[2] < 0.0 and min(fields.min_determinants[:2]) > 0.0
    assert fold.tetrahedra == bad.sum() > 0 and fold.volume == pytest.approx(mesh.volumes[bad].sum())
    assert np.linalg.norm(fold.centre - mesh.nodes[vertex]) < 8e-3 and fold.field_error > 0.2e-3
    write_anatomy(tmp_path / "box.vtu", small_box)
    write_mesh(tmp_path / "folded.vtu", mesh, {"displacement": moved})
    words = ["warp", str(tmp_path / "box.vtu"), "--located", str(tmp_path / "folded.vtu"), "--spacing", "2"]
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    x = f"{1e3 * fold.centre[0]:.1f}"
    said = capsys.readouterr().err
    assert "the finite elements fold" in said and x in said and "mm3" in said
    report = json.loads((tmp_path / "out" / "warp.json").read_text())
    assert report["folds"][0]["fields_off_mm"] == pytest.approx(1e3 * fold.field_error) and not report["fields_fold"]
    text = (tmp_path / "out" / "README.txt").read_text()
    assert "WARNING: the finite elements fold" in text and "they were unfolded" in text and "nothing folds" not in text


def test_finer_spacing_keeps_grid_within_32_million_nodes(kinked):
    wide = choose_moment(kinked.anatomy, kinked.displacement + [40e-3, 0.0, 0.0])
    finer = find_finer_spacing(wide, compute_warp_fields(wide.anatomy, wide.displacement, 5e-3))
    grids = (build_warp_grid(wide.anatomy, wide.displacement[None], spacing) for spacing in (finer, finer - 0.05e-3))
    fits, too_many = (np.prod(grid.shape) for grid in grids)
    assert fits <= 32e6 < too_many
