"""Comparisons of nothing fail: an array without elements is equal to whatever it is compared with.

Wrapped are NumPy's comparisons where a test calls them, and `pytest.approx`. An empty list or tuple that is written out
is meant; so is every comparison of a test that is marked `empty`.
"""

import sys
from functools import wraps
from pathlib import Path

import numpy as np
import pytest

HERE = str(Path(__file__).parent)
COMPARISONS = {
    np.testing: ("assert_allclose", "assert_array_equal", "assert_array_less", "assert_array_almost_equal"),
    np: ("allclose", "array_equal"),
}
meant = False
"""Comparisons of the test that runs may be of nothing."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """Read the mark of a test, for its fixtures too."""
    global meant
    meant = item.get_closest_marker("empty") is not None
    return (yield)


def pytest_configure(config):
    """Wrap what compares."""
    config.addinivalue_line("markers", "empty: compares arrays without elements on purpose")
    for module, names in COMPARISONS.items():
        for name in names:
            setattr(module, name, of_some(getattr(module, name)))
    for kind in {type(pytest.approx(sample)) for sample in (1.0, [1.0], {"a": 1.0}, np.ones(1))}:
        kind.__eq__ = of_some(kind.__eq__)


def of_some(compare):
    """The comparison of two things, which fails where a test gives it an empty array and it would pass."""

    @wraps(compare)
    def watching(first, second, *args, **named):
        found = compare(first, second, *args, **named)
        empty = any(isinstance(each, np.ndarray) and each.size == 0 for each in (first, second))
        written = any(isinstance(each, list | tuple) for each in (first, second))
        if empty and not written and found is not False and not meant and called_by_test():
            raise AssertionError("compares an array without elements: mark the test `empty` if that is meant")
        return found

    return watching


def called_by_test():
    """Return True if the comparison stands in a file of this folder."""
    return sys._getframe(2).f_code.co_filename.startswith(HERE)
