"""Answers of the finite elements to the loads of a data set, and the errors of a model against them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.bodies.tip_distance import tip_gauge
from sim.errors import InputError
from sim.loads import Loads, Pushed, rows_of

from ..data.cortex_patch import Patch
from ..data.dataset import Dataset
from ..data.holding import stated_series
from ..data.indentation import indented, with_relaxed
from ..evaluation.score import errors, force_errors
from ..model.learned import Learned, only_pushed
from ..model.relaxation import followed
from .bounds import KnownDistances, Missed, distance_errors, missed
from .examples import Examples
from .expansion import Expansion


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of a model on B loads: at the tumour's worst vertex, of the distance from tip to tumour, of the force.

    The force is that of a tool moved by pose; None where it is not known.
    """

    tumour: Missed
    tip: Missed
    force: Missed | None = None

    def known(self) -> dict[str, Missed]:
        """Errors that are known, by the names of `WAYS`."""
        found = {"tumour": self.tumour, "tip": self.tip}
        return found if self.force is None else {**found, "force": self.force}


@dataclass(frozen=True, eq=False)
class Answers:
    """Answers of the finite elements to the B loads of a data set that converged.

    Parameters
    ----------
    loads, pushed
        As the data set has them, and as a model is asked them.
    patch, nodes
        Open cortex, and the tumour's vertices (n,).
    tumour, cortex
        Displacements (B, n, 3) and (B, c, 3) [m].
    distances
        From tip to tumour.
    force
        (B, 3) [N] of a tool moved by pose; None where it is not known.
    """

    loads: Loads
    pushed: Pushed
    patch: Patch
    nodes: np.ndarray
    tumour: np.ndarray
    cortex: np.ndarray
    distances: KnownDistances
    force: np.ndarray | None

    def examples(self, rows: np.ndarray) -> Examples:
        """The chosen rows (B,) bool, to fit models on."""
        force = None if self.force is None else self.force[rows]
        return Examples(rows_of(self.pushed, rows), self.tumour[rows], self.cortex[rows], force)

    def vertex_errors(self, model: Learned, rows: np.ndarray) -> np.ndarray:
        """Errors (k, n) [m] of a model at the tumour's vertices, on the chosen rows (B,) bool."""
        return errors(model, self.loads.rows(np.flatnonzero(rows)), self.tumour[rows], self.nodes)

    def errors_of(
        self, model: Learned, rows: np.ndarray, tumour: np.ndarray | None = None, tip: np.ndarray | None = None
    ) -> Errors:
        """Errors of a model on the chosen rows (B,) bool; those at the tumour or of the tip (k,) [m] may be known."""
        asked = rows_of(self.pushed, rows)

        def of(error: np.ndarray) -> Missed:
            return missed(model, self.patch, asked, error)

        return Errors(
            of(self.vertex_errors(model, rows).max(axis=1) if tumour is None else tumour),
            of(distance_errors(model, self.distances.rows(rows)) if tip is None else tip),
            None if self.force is None else of(force_errors(model.exerted(asked), self.force[rows])),
        )


def answers_of(data: Dataset, shared: Expansion) -> Answers:
    """Read the answers to the loads of a data set that converged.

    Raises
    ------
    InputError
        Unit responses that did not converge; an anatomy without tumour; loads other than `Pushed`, or the `Touching`
        of one tool.
    """
    if not data.unit_good.all():
        raise InputError(
            f"{data.path}: {int((~data.unit_good).sum())} unit responses did not converge, so there is no compliance "
            "table: simulate anew with a looser --tolerance."
        )
    loads = data.loads.rows(np.flatnonzero(data.good))
    pushed, nodes = _asked(data, loads, shared.patch), shared.tumour
    if not len(nodes):
        raise InputError(f"{data.path}: its anatomy has no tumour to predict: make one that has.")
    tumour = data.displacement(nodes)[data.good]
    cortex = data.displacement(shared.cortex)[data.good]
    at, both = np.concatenate([nodes, shared.cortex]), np.concatenate([tumour, cortex], axis=1)
    distances = KnownDistances(loads, tip_gauge(data.anatomy).distances(loads, both, at, data.tool))
    reaction = None if data.tool is None else data.reaction()
    force = None if reaction is None else reaction[data.good, 0, :3]
    return Answers(loads, pushed, shared.patch, nodes, tumour, cortex, distances, force)


def _asked(data: Dataset, loads: Loads, patch: Patch) -> Pushed:
    """Loads of a data set as a model is asked them, like `Learned.asked`."""
    if data.tool is not None:
        pushed, series = indented(loads, data.tool, patch), stated_series(data.provenance)
        if not series:
            return pushed
        return with_relaxed(pushed, followed(series, pushed, loads.times, None, 0.0).share)
    if loads.only(Pushed) is None:
        raise InputError(
            "the data holds other loads than `Pushed`, which the learners do not take: simulate pushes, or one tool's "
            "poses."
        )
    return only_pushed(loads)
