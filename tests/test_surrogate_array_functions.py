"""Rounding of a model's tables, which makes the bytes of its file reproducible."""

import numpy as np
import pytest

from surrogate.array_functions import QuantisedTable, multiply_rows, round_to_half, take_rows
from surrogate.regressors.force_series import ForcePairs, Series
from surrogate.regressors.gp import Gp

TABLE = np.random.default_rng(0).normal(size=(50, 4)) * [1.0, 10.0, 1e-3, 0.0]


@pytest.mark.parametrize("step", [0.01, np.array([0.01, 0.1, 1e-5, 1.0])])
def test_rounded_table_error_is_at_most_half_a_step(step):
    rounded = QuantisedTable.quantise(TABLE, step)
    assert rounded.integers.dtype == np.int16 and rounded.values.flags.c_contiguous
    assert (np.abs(rounded.values - TABLE) <= 0.5001 * np.asarray(step)).all()


def test_rounding_step_increases_to_avoid_integer_overflow():
    rounded = QuantisedTable.quantise(TABLE, 1e-6)
    largest = np.abs(TABLE).max(axis=0)
    assert rounded.step == pytest.approx(np.maximum(1e-6, largest / 32767))
    np.testing.assert_allclose(rounded.values, TABLE, atol=largest.max() / 32767)


def test_rounded_rows_and_products_equal_those_of_values():
    rounded, rows = QuantisedTable.quantise(TABLE, 0.01), np.array([3, 1, 3])
    np.testing.assert_array_equal(take_rows(rows, rounded), rounded.values[rows])
    np.testing.assert_array_equal(multiply_rows(np.ones((1, 3)), rounded, rows)[0], rounded.values[rows].sum(axis=0))


def test_half_precision_keeps_eleven_bits_at_any_magnitude():
    numbers = np.array([1.0, -3.14159, 6.1e-9, 2.5e20, 0.0])
    found = round_to_half(numbers)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, numbers, rtol=2.0**-11)
    assert (round_to_half(np.ldexp(np.arange(2048.0), -30)) == np.ldexp(np.arange(2048.0), -30)).all()


def test_tables_of_earlier_versions_are_read():
    """They store ratios in half precision, and rows of a Gaussian process divided by length scales."""
    share = (TABLE[:, :3] / TABLE[:, :3].max(axis=0)).astype(np.float16)
    unit = TABLE[:, :3].max(axis=0).astype(np.float32)
    pairs = ForcePairs.restored({"pairs": np.zeros((50, 2), int), "share": share, "unit": unit})
    np.testing.assert_allclose(pairs.table.values, TABLE[:, :3], rtol=1e-3)
    table = {"share": share.reshape(5, 10, 1, 3), "unit": unit[None]}
    places = {"corners": np.zeros((3, 3)), "triangles": np.zeros((1, 6), int), "radii": np.ones(10)}
    np.testing.assert_allclose(Series.restored({**places, **table}).table.values, TABLE[:, :3], rtol=1e-3)
    process = Gp().fit(TABLE[:, :2], TABLE[:, 2:])
    state = process.state()
    seen = state.pop("scaled") / state["length"]
    again = Gp.restored({**state, "seen": seen})
    np.testing.assert_allclose(again.predict(TABLE[:, :2]), process.predict(TABLE[:, :2]), rtol=1e-6)
