"""Comparisons in tests have elements to compare, and tests are skipped only for listed reasons."""

from types import SimpleNamespace

import numpy as np
import pytest
from expected_skips import as_failed

EMPTY, SOME = np.zeros((0, 3)), np.ones(2)
COMPARISONS = {
    "allclose": lambda: np.allclose(EMPTY, 1.0),
    "array_equal": lambda: np.array_equal(EMPTY, EMPTY.copy()),
    "assert_allclose": lambda: np.testing.assert_allclose(EMPTY, 1.0),
    "assert_array_equal": lambda: np.testing.assert_array_equal(EMPTY, 1.0),
    "assert_array_less": lambda: np.testing.assert_array_less(EMPTY, 1.0),
    "a number": lambda: pytest.approx(1.0) == EMPTY,
    "an array": lambda: pytest.approx(EMPTY) == EMPTY,
}


@pytest.mark.parametrize("name", COMPARISONS)
def test_comparison_of_empty_arrays_fails(name):
    with pytest.raises(AssertionError, match="array without elements"):
        COMPARISONS[name]()


@pytest.mark.empty
@pytest.mark.parametrize("name", COMPARISONS)
def test_comparison_of_empty_arrays_in_marked_test_passes(name):
    COMPARISONS[name]()


def test_comparison_with_literal_empty_list_passes():
    np.testing.assert_array_equal(EMPTY[:, 0], [])
    assert not np.array_equal(EMPTY, SOME) and pytest.approx(SOME) == SOME and pytest.approx([]) == []


@pytest.mark.parametrize(
    ("reason", "outcome"),
    [("no CUDA device here", "skipped"), ("needs SULCUS_PVPYTHON, ParaView's pvpython", "skipped"), ("slow", "failed")],
)
def test_skipped_test_with_unlisted_reason_fails(reason, outcome):
    report = SimpleNamespace(skipped=True, outcome="skipped", longrepr=("test_a.py", 1, f"Skipped: {reason}"))
    assert as_failed(report).outcome == outcome
