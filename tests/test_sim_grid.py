"""Displacement on a grid, forward and inverse: exact in the body, continuous, fading outside, without folds."""

import numpy as np
import pytest

from sim.fields.folds import compute_jacobians, unfold_field
from sim.fields.warp_fields import compute_cutoff, compute_warp_fields, remove_negligible


def bump(nodes, depth=5e-3, width=14e-3):
    """A push on the top, which dies away to the held sides: (V, 3) [m]."""
    across = np.exp(-(np.linalg.norm(nodes[:, :2], axis=1) ** 2) / (2 * width**2))
    fades = np.clip(1.0 - np.linalg.norm(nodes[:, :2], axis=1) / 25e-3, 0.0, 1.0) * np.clip(
        1 + nodes[:, 2] / 42e-3, 0, 1
    )
    push = -depth * across * fades
    return np.stack([-0.4 * push * nodes[:, 0] / width, 0.2 * push, push], axis=1)


@pytest.fixture(scope="module")
def moved(box):
    return bump(box.mesh.nodes)


@pytest.fixture(scope="module")
def fields(box, moved):
    return compute_warp_fields(box, moved, 1e-3)


def errors(box, moved, fields):
    """How far the fields, read between nodes, are from what moves a body: at its vertices, (2, V) [m]."""
    rest, grid = box.mesh.nodes, fields.grid
    off = grid.interpolate(fields.forward, rest) - moved, grid.interpolate(fields.backward, rest + moved) + moved
    return np.linalg.norm(off, axis=-1)


def test_both_fields_map_vertices_to_their_positions(box, moved, fields):
    """Sampling alone has an error of 0.15 mm, and 0.1 mm below the surface."""
    error = errors(box, moved, fields)
    assert np.median(error) < 6e-6 and error.max() < 0.1e-3
    inner = box.mesh.nodes[:, 2] < -12e-3
    assert np.quantile(error, 0.98) < 0.04e-3 and error[:, inner].max() < 0.05e-3


def test_faint_motion_is_set_to_zero_and_shrinks_the_grid(box, moved, fields):
    rest = compute_warp_fields(box, 1e-3 * moved, 1e-3)
    faint = compute_cutoff(moved)
    assert compute_cutoff(1e-3 * moved) == pytest.approx(2.5e-6 * np.linalg.norm(moved, axis=1).max())
    assert compute_cutoff(1e-3 * moved) < faint <= 2e-5
    size, left = np.linalg.norm(moved, axis=1), remove_negligible(moved)
    assert not left[size < faint].any() and np.array_equal(left[size > 2 * faint], moved[size > 2 * faint])
    assert np.linalg.norm(left - moved, axis=1).max() < 1.1 * faint
    assert np.prod(rest.grid.shape) < np.prod(fields.grid.shape) and rest.forward.any()
    still = np.where(box.mesh.nodes[:, :1] > 0.0, moved, 0.0)
    half = compute_warp_fields(box, still, 1e-3).grid
    assert half.shape[0] < fields.grid.shape[0]


def test_fields_have_no_folds_and_bounded_jacobians(fields):
    assert not fields.has_folds and min(fields.min_determinants) > 0.5
    for field, least in ((fields.forward, fields.min_determinants[0]), (fields.backward, fields.min_determinants[1])):
        gradient = np.stack(np.gradient(field.astype(float), fields.grid.spacing, axis=(1, 2, 3)), axis=-1)
        between = np.linalg.det(np.moveaxis(gradient, 0, -2) + np.eye(3))
        assert between.min() > least > 0.0


def test_field_is_continuous_and_zero_at_the_grid_edge(box, fields):
    """From node to node the field changes by no more than the strain of the tissue."""
    for field in (fields.forward, fields.backward):
        steps = max(np.abs(np.diff(field, axis=axis)).max() for axis in (1, 2, 3))
        assert steps < 0.9 * fields.grid.spacing
        for axis in (1, 2, 3):
            assert np.abs(np.take(field, [0, -1], axis=axis)).max() < 1e-12
    below = np.array([[x, y, -43.5e-3] for x in (-20e-3, 0.0, 20e-3) for y in (-20e-3, 0.0)])
    assert np.abs(fields.grid.interpolate(fields.forward, below)).max() < 1e-9  # a skull that holds is left where it is


def test_field_is_smooth_across_the_surface_of_the_body(box, moved, fields):
    top = np.array([[2e-3, 1e-3, 0.0], [-5e-3, 4e-3, 0.0], [8e-3, -3e-3, 0.0]])
    below, at, above = (fields.grid.interpolate(fields.forward, top + [0, 0, z]) for z in (-5e-4, 0.0, 5e-4))
    assert np.abs((above - at) - (at - below)).max() < 2e-5 < np.abs(at - below).max()


def test_fields_outside_body_are_inverse_to_each_other(box, fields):
    around = np.array([[x, y, z] for x in (-8e-3, 0.0, 7e-3) for y in (-4e-3, 5e-3) for z in (3e-3, 6e-3)])
    back = around + fields.grid.interpolate(fields.backward, around)
    assert np.abs(back + fields.grid.interpolate(fields.forward, back) - around).max() < 0.05e-3


def test_inverted_region_is_unfolded():
    """Local moves alone end in a minimum that still folds."""
    x, y, z = np.indices((14, 14, 14)) - 6.5
    core = np.exp(-(x**2 + y**2 + z**2) / 6.0)
    field = np.stack([-4e-3 * x * core, 0.0 * y, 0.0 * z]).astype(np.float32)
    assert compute_jacobians(field, 1e-3).min() < -2.0
    inside = np.ones(field.shape[1:], bool)
    assert unfold_field(field, inside, ~inside, 1e-3) == compute_jacobians(field, 1e-3).min() > 0.0


def test_unfolding_changes_field_outside_the_body_first():
    rng = np.random.default_rng(1)
    field = np.zeros((3, 20, 20, 20), np.float32)
    field[:, 8:12, 8:12, 8:12] = rng.uniform(-1.5e-3, 1.5e-3, (3, 4, 4, 4))
    assert compute_jacobians(field, 1e-3).min() < 0.0
    inside, collar = np.zeros((2, *field.shape[1:]), bool)
    free = field.copy()
    assert unfold_field(free, inside, collar, 1e-3) == compute_jacobians(free, 1e-3).min() > 0.0
    inside[:10] = True
    held = field.copy()
    assert unfold_field(held, inside, collar, 1e-3) > 0.0
    moved = np.linalg.norm(held - field, axis=0)
    assert moved[10:].max() > 2.0 * moved[:10].max() and not moved[:4].any()
    collar[10] = True
    round_body = field.copy()
    assert unfold_field(round_body, inside, collar, 1e-3) > 0.0
    assert np.linalg.norm(round_body - field, axis=0)[10].max() < 0.9 * moved[10].max()


def test_fold_at_any_corner_of_a_cell_is_found():
    for corner in np.ndindex(2, 2, 2):
        field = np.zeros((3, 2, 2, 2), np.float32)
        field[(slice(None), *corner)] = 0.7e-3 * (1 - 2 * np.array(corner))  # past the middle of its neighbours
        assert compute_jacobians(field, 1e-3).min() < 0.0 < compute_jacobians(0.3 * field, 1e-3).min()


def test_resected_tissue_is_marked_in_the_grid(box, moved):
    cut = np.flatnonzero(box.mesh.region == 2)
    found = compute_warp_fields(box, moved, 2e-3, box.remove_elements(cut))
    middle = box.mesh.nodes[box.mesh.tets[cut]].mean(axis=(0, 1))
    place = tuple(np.rint(found.grid.to_indices(middle)).astype(int))
    assert found.resected[place] and not found.has_folds
    assert not found.resected[tuple(np.rint(found.grid.to_indices(middle + [0, 0, 14e-3])).astype(int))]
