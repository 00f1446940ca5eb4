"""Extension of a field beyond its known domain."""

import numpy as np

from sim.fields.extension import extend_field


def test_extended_field_never_exceeds_known_values():
    known = np.zeros((24, 24, 24), bool)
    known[10:14, 10:14, 10:14] = True
    field = np.where(known, np.float32(2e-3), np.float32(0.0)) * np.ones((3, 1, 1, 1), np.float32)
    filled = extend_field(field, known, 8.0)
    assert np.array_equal(filled[:, known], field[:, known]) and filled.max() <= 2e-3 * (1 + 1e-6)
    line = filled[0, 12, 12, 13:]
    assert (np.diff(line) <= 0).all() and line[-1] == 0.0 and line[2] > 1e-3
