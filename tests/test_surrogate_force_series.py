"""Power series of a force: its forms, and interpolation between its places."""

import numpy as np
import pytest
from test_surrogate_expansion import pushes, unrounded

from sim.errors import InputError
from sim.loads import Pushed
from surrogate.data.encode import compute_tool_features, split_forces
from surrogate.regressors.force_series import Series, compute_direction_monomials, interpolate_table
from surrogate.training.fem_tables import add_edge_midpoints, choose_radii


def test_quadratic_fields_are_interpolated_exactly(patch):
    triangles, places = add_edge_midpoints(patch)
    radii = choose_radii(5e-3, 8e-3)
    random = np.random.default_rng(1)
    shape = random.normal(size=(3, 3))

    def field(point):
        return 1e4 * np.einsum("ni,ij,nj->n", point, shape, point)

    table = np.zeros((len(places), len(radii), 19, 2), np.float32)
    table[:, :, 0, 0] = field(places)[:, None] + np.log(radii / 5e-3) ** 2
    table[:, :, 18, 1] = 1.0  # the form d_z^3
    series = Series(patch.points, triangles, radii, unrounded(table))
    loads = pushes(patch, 200, 2, (5e-3, 8e-3))
    size, direction = split_forces(loads)
    predicted = series.predict(compute_tool_features(patch, loads))
    wanted = direction[:, 0] * (field(loads.point) + np.log(loads.footprint / 5e-3) ** 2)
    assert np.allclose(predicted[:, 0], wanted, atol=1e-4 * np.abs(wanted).max())
    assert np.allclose(predicted[:, 1], size**2 * direction[:, 2] ** 3, atol=1e-6)
    alone = np.concatenate([series.predict(compute_tool_features(patch, _row(loads, k))) for k in range(5)])
    assert np.allclose(alone, predicted[:5], rtol=1e-5, atol=1e-7)


def test_empty_loads_give_empty_responses(patch):
    (triangles, places), radii = add_edge_midpoints(patch), choose_radii(5e-3, 8e-3)
    series = Series(patch.points, triangles, radii, unrounded(np.ones((len(places), len(radii), 19, 2))))
    none = compute_tool_features(patch, Pushed(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)))
    assert series.predict(none).shape == (0, 2)


def _row(loads, k):
    return Pushed(loads.point[k : k + 1], loads.force[k : k + 1], loads.footprint[k : k + 1])


def test_force_forms_span_polynomials_of_their_degree():
    random = np.random.default_rng(0)
    direction = random.normal(size=(40, 3))
    values = compute_direction_monomials(direction, np.ones(40))
    assert np.allclose(
        compute_direction_monomials(2.0 * direction, np.ones(40)), values * np.repeat([2.0, 4.0, 8.0], [3, 6, 10])
    )
    for columns, degree in ((slice(0, 3), 1), (slice(3, 9), 2), (slice(9, 19), 3)):
        wanted = (direction @ random.normal(size=3)) ** degree
        found = np.linalg.lstsq(values[:, columns], wanted, rcond=None)[0]
        assert np.allclose(values[:, columns] @ found, wanted)


def test_omitted_table_entries_are_interpolated(patch):
    """Linear fields are reproduced, on a flat cortex too; omitted entries have no influence."""
    places = add_edge_midpoints(patch)[1]
    left_out = np.linalg.norm(places[:, :2] - [5e-3, 0.0], axis=1) < 6e-3
    wanted = (places @ np.random.default_rng(0).normal(size=(3, 4)) + 2.0).reshape(-1, 2, 2)
    wild = np.where(left_out[:, None, None], 1e9, wanted)
    assert 0 < left_out.sum() < len(places)
    np.testing.assert_allclose(interpolate_table(places, wild, left_out), wanted, rtol=1e-9)
    with pytest.raises(InputError, match="hold all places"):
        interpolate_table(places, wild, np.ones(len(places), bool))
