"""Shares of causes in a motion."""

import numpy as np
import pytest

from surrogate.locating.cause_shares import group_cause_shares
from surrogate.locating.causes import KINDS


def test_inseparable_causes_are_grouped_together():
    """Two causes with exchangeable shares form a group, a constant share stays alone, and zero shares are omitted."""
    first = np.random.default_rng(0).uniform(0.0, 0.8, 2000)
    drawn = np.stack([np.full(2000, 0.2), first, 0.8 - first, np.zeros(2000)], axis=1)
    both, alone = group_cause_shares(drawn)
    assert both.causes == KINDS[1:3] and (both.share, both.low, both.high) == pytest.approx((0.8, 0.8, 0.8))
    assert str(alone) == "tool 20 % (20 to 20 %)"
    assert str(both) == "drainage or swelling or shrinking (not separable) 80 % (80 to 80 %)"
    narrow = group_cause_shares(np.stack([first / 4.0, 1.0 - first / 4.0, 0.0 * first, 0.0 * first], axis=1))
    assert [each.causes for each in narrow] == [("drainage",), ("tool",)]
    assert narrow[1].low == pytest.approx(0.01, abs=0.003) and narrow[1].high == pytest.approx(0.19, abs=0.003)
