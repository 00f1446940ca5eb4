"""Geometry-based models against closed forms."""

import numpy as np
import pytest
from conftest import make_box

from sim.effects import build_push_effects
from sim.families.geometric import compute_kelvinlet_response, compute_lattice_response, compute_thin_plate_response
from sim.families.linear_body import build_linear_body
from sim.material import Material

TISSUE = Material("neo-hookean", 3000.0, 0.4)
MU = TISSUE.lame[0]


@pytest.fixture(scope="module")
def body():
    anatomy = make_box((10, 10, 6), 6e-3, opening=24e-3)
    return build_linear_body("here", anatomy, build_push_effects(anatomy, TISSUE))


def test_kelvinlet_far_from_fixed_tissue_agrees_with_kelvin():
    """Without fixed vertices at its side, at ten radii: u = ((3 - 4 nu) I + r r^T / r^2) f / (16 pi mu (1 - nu) r)."""
    anatomy = make_box((20, 20, 10), 0.1, opening=0.9)
    body = build_linear_body("here", anatomy, build_push_effects(anatomy, TISSUE))
    middle = int(np.flatnonzero((np.abs(anatomy.mesh.nodes) < 1e-9).all(axis=1))[0])
    below = int(np.linalg.norm(anatomy.mesh.nodes - [0.0, 0.0, -0.4], axis=1).argmin())
    found = compute_kelvinlet_response(body, np.array([below]))[np.searchsorted(body.loaded, middle)][:, 0]
    kelvin = (3.0 - 1.6 + np.array([0.0, 0.0, 1.0])) / (16.0 * np.pi * MU * 0.6 * 0.4)
    held = np.diag(found) / kelvin
    assert (held > 0.4).all() and (held < 1.0).all()  # the fixed floor at 1 m and walls reduce it
    assert np.abs(found - np.diag(np.diag(found))).max() < 0.01 * found.max()


def test_kelvinlets_hardly_move_fixed_vertices(body):
    fixed = np.flatnonzero(body.fixed)
    moved = np.abs(compute_kelvinlet_response(body, fixed)).max(axis=(0, 1, 3))
    assert moved.max() < 0.05 * np.abs(compute_kelvinlet_response(body, body.loaded)).max()


@pytest.mark.parametrize(
    ("respond", "tolerance"), [(compute_thin_plate_response, 1e-6), (compute_lattice_response, 0.2)]
)
def test_surface_displacement_agrees_with_half_space(body, respond, tolerance):
    """Boussinesq: u_z = (1 - nu) / (2 pi mu r); Cerruti along the force: 1 / (2 pi mu r) (Johnson 1985)."""
    points = body.anatomy.mesh.nodes[body.loaded]
    middle, other = (int(np.linalg.norm(points - at, axis=1).argmin()) for at in ([0, 0, 0], [12e-3, 0, 0]))
    found = respond(body, body.loaded)[middle, :, other]
    r = 12e-3
    assert found[2, 2] == pytest.approx(0.6 / (2.0 * np.pi * MU * r), rel=max(0.05, tolerance))
    assert found[0, 0] == pytest.approx(1.0 / (2.0 * np.pi * MU * r), rel=max(0.05, tolerance))
    # A force outwards draws the surface away from it: 1 - 2 nu.
    assert found[2, 0] == pytest.approx(0.2 / (4.0 * np.pi * MU * r), rel=max(0.1, 2 * tolerance))


def test_thin_plate_displacement_decreases_with_depth(body):
    """Between loaded and fixed vertices."""
    points = body.anatomy.mesh.nodes
    column = np.flatnonzero(np.linalg.norm(points[:, :2], axis=1) < 1e-9)
    column = column[np.argsort(-points[column, 2])]
    middle = int(np.linalg.norm(points[body.loaded], axis=1).argmin())
    depth = compute_thin_plate_response(body, column)[middle, 2, :, 2]
    assert (np.diff(depth) < 0.0).all()
    assert abs(depth[-1]) < 0.02 * depth[0]
