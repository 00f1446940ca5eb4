"""Choosing a learner's settings inside its training loads: no other load has an influence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..data.cortex_patch import nearest
from ..data.tool_loads import spread
from ..regressors.protocol import Fitted, Teachable

# The loads nearest to so many places far apart are left out of the inner fits: about this share of all.
CENTRES, SHARE = 6, 0.2
# Fewer loads choose nothing: the first settings are taken. So many choose, and of the outputs the strongest decide.
FEWEST, MOST, STRONGEST = 40, 600, 8


@dataclass(frozen=True)
class Tuned:
    """Settings of a regressor, of which those are taken that are nearest on discs left out of the training rows.

    One fit for each of the settings, to the strongest outputs of four fifths of the first rows, then one to all rows.

    Parameters
    ----------
    settings
        Regressors to choose from; the first is taken where there are few rows.
    """

    settings: tuple[Callable[[], Teachable], ...]

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Fitted:
        """The best of the regressors, trained on rows X (n, f) of `tool_features`, Y (n, r)."""
        return self.settings[self.best(X, Y)]().fit(X, Y)

    def best(self, X: np.ndarray, Y: np.ndarray) -> int:
        """Which of the settings has the least squared error on the discs; the same rows choose the same."""
        if len(X) < FEWEST or len(self.settings) == 1:
            return 0
        X, Y = X[:MOST], Y[:MOST]
        left_out = inner_discs(X[:, :3])
        strongest = Y[:, np.sort(np.argsort(-Y.std(axis=0), kind="stable")[:STRONGEST])]
        errors = []
        for make in self.settings:
            model = make().fit(X[~left_out], strongest[~left_out])
            errors.append(float(np.square(model.predict(X[left_out]) - strongest[left_out]).sum()))
        return int(np.argmin(errors))


def inner_discs(points: np.ndarray) -> np.ndarray:
    """Which rows (n,) bool lie in discs round `CENTRES` of the points (n, 3) far from each other."""
    distance = nearest(points, points[spread(points, CENTRES)])[1]
    return distance <= np.quantile(distance, SHARE)
