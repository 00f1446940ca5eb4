"""How well a model of poses knows the force that its tool exerts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.errors import InputError
from sim.loads import Loads

from ..model.learned import Learned
from .coverage import Held, held_by, held_words


@dataclass(frozen=True)
class ForceScore:
    """The error of a tool's force, the length of a vector, over n loads under which it presses.

    Parameters
    ----------
    loads
        n.
    force
        Mean of the finite elements' forces [N].
    mean
        Of the errors [N].
    mean_percent, p95_percent
        Of each error divided by its load's force [%].
    held
        Shares of the loads whose error lies below the bound, as in `Coverage`; None where none is promised.
    bound
        Median of the bound at the first level [N]; None as above.
    """

    loads: int
    force: float
    mean: float
    mean_percent: float
    p95_percent: float
    held: Held | None = None
    bound: float | None = None

    def __str__(self) -> str:
        promised = "no bounds"
        if self.held is not None and self.bound is not None:
            promised = f"bounds held for {held_words(self.held)}; median bound {self.bound:.4f} N"
        return (
            f"mean error {self.mean:.4f} N of {self.force:.3f} N, {self.mean_percent:.2f} % of each load's force, "
            f"p95 {self.p95_percent:.2f} %; {promised}"
        )


def force_errors(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Lengths (B,) [N] of the differences between forces (B, 3)."""
    return np.linalg.norm(found - truth, axis=1)


def force_score(error: np.ndarray, truth: np.ndarray, bound: np.ndarray | None = None) -> ForceScore:
    """Score errors (B,) [N] of true forces (B, 3) [N], with bounds (2, B) [N] if there are any.

    Raises
    ------
    InputError
        Loads under which no tool presses.
    """
    size = np.linalg.norm(truth, axis=1)
    some = size > 0.0
    if not some.any():
        raise InputError(
            "no tool presses under any of these loads, so that no force can be judged: give poses that do."
        )
    share = 100.0 * error[some] / size[some]
    if bound is not None and np.isnan(bound).all():
        bound = None
    return ForceScore(
        int(some.sum()),
        float(size[some].mean()),
        float(error[some].mean()),
        float(share.mean()),
        float(np.percentile(share, 95.0)),
        held_by(error[some], bound[:, some]) if bound is not None else None,
        float(np.median(bound[0, some])) if bound is not None else None,
    )


def judged_force(model: Learned, loads: Loads, truth: np.ndarray) -> ForceScore:
    """Score a model's forces against the finite elements' (B, 3) [N]."""
    answer = model.deform(loads, at=model.anatomy.tumour_nodes)
    return force_score(force_errors(answer.reaction[:, 0, :3], truth), truth, answer.reaction_bound)
