"""From a data set to models and their scores."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sim.errors import InputError
from sim.loads import Loads, Pushed
from sim.stages import stage

from .ann import Ann
from .dataset import Dataset
from .encode import ENCODERS, directions, reduce
from .envelope import envelope_of
from .gp import Gp
from .learned import Learned, Part
from .linear import Linear
from .patch import Patch, open_patch
from .pcr import Pcr
from .regressor import Regressor
from .score import Score, errors, score
from .split import Split, leave_discs_out
from .svr import Svr

# Encoder and regressor of each but the table itself; principal components are those of the forces at the nodes.
LEARNT: dict[str, tuple[str, Callable[[], Regressor]]] = {
    "pcr": ("nodal", Pcr),
    "ann": ("tool", Ann),
    "svr": ("tool", Svr),
    "gp": ("tool", Gp),
    "residual": ("tool", Ann),
}
LEARNERS = ("linear", *LEARNT)
# Share of the responses that a learner's basis may lose, and its most modes; and what the table may lose.
TOLERANCE, MODES = 1e-3, 60
TABLE_TOLERANCE = 1e-4
COVERAGE = 0.95


@dataclass(frozen=True, eq=False)
class Trained:
    """Models by learner, how they scored on the discs left out, and what those were.

    `motion` is the mean displacement [m] of the tumour over the held-out loads.
    """

    models: dict[str, Learned]
    scores: tuple[Score, ...]
    split: Split
    motion: float


def train(
    data: Dataset,
    learners: Sequence[str] = LEARNERS,
    progress: Callable[[str], object] = lambda learner: None,
    split: Split | None = None,
) -> Trained:
    """Fit `learners` to the loads outside the left-out discs, and score them inside.

    Another `split` has a row for each load that converged.

    Every model knows the tumour and the open cortex; the cortex, which is drawn but not scored, is the compliance
    table's in all of them. Cases that did not converge are neither learnt nor scored.

    Raises
    ------
    InputError
        Unknown learners, data with other causes than `Pushed`, an anatomy without tumour, too few loads, or unit
        responses that did not converge.
    """
    unknown = [name for name in learners if name not in LEARNERS]
    if unknown or not learners:
        raise InputError(f"no learner is called {', '.join(unknown) or 'nothing'}: choose from {', '.join(LEARNERS)}.")
    if not data.unit_good.all():
        raise InputError(
            f"{data.path}: {int((~data.unit_good).sum())} unit responses did not converge, so there is no compliance "
            "table: simulate anew with a looser --tolerance."
        )
    loads = data.loads.rows(np.flatnonzero(data.good))
    pushed = _pushed(loads)
    patch, nodes = open_patch(data.anatomy), data.anatomy.tumour_nodes
    if not len(nodes):
        raise InputError(f"{data.path}: its anatomy has no tumour to predict: make one that has.")
    split = leave_discs_out(pushed.point, patch) if split is None else split
    with stage("table"):
        truth = data.displacement(nodes)[data.good]
        table = _compliance(data, nodes)
        open_nodes = np.setdiff1d(patch.nodes, nodes)
        cortex = (_compliance(data, open_nodes),) if len(open_nodes) else ()
    taught, held_out = (_pushed(loads.rows(np.flatnonzero(rows))) for rows in (split.taught, split.test))
    envelope = envelope_of(patch, taught, held_out)
    models, scores = {}, []
    for name in dict.fromkeys(learners):
        with stage(f"learn {name}"):
            parts = (*_parts(name, table, patch, taught, truth[split.taught]), *cortex)
        model = Learned(data.anatomy, parts, envelope, training={"learner": name, **data.provenance})
        with stage("score"):
            models[name], row = _judged(name, model, loads.rows(np.flatnonzero(split.test)), truth[split.test], nodes)
        scores.append(row)
        progress(name)
    return Trained(models, tuple(scores), split, float(np.linalg.norm(truth[split.test], axis=2).mean()))


def _parts(name: str, table: Part, patch: Patch, taught: Pushed, truth: np.ndarray) -> tuple[Part, ...]:
    """The summands of one learner, for displacements `truth` (n, k, 3) [m] of the tumour."""
    if name == "linear":
        return (table,)
    response = truth / directions(taught)[0][:, None, None]
    before = (table,) if name == "residual" else ()
    for part in before:
        response = response - part.response(ENCODERS[part.encoder](patch, taught))
    basis = reduce(table.basis.nodes, response, TOLERANCE, MODES)
    encoder, regressor = LEARNT[name]
    fitted = regressor().fit(ENCODERS[encoder](patch, taught), basis.encode(response))
    return (*before, Part(encoder, fitted, basis))


def _compliance(data: Dataset, nodes: np.ndarray) -> Part:
    """The compliance table of some vertices, from the unit responses, in as many modes as it needs."""
    response = data.unit_response(nodes)
    basis = reduce(nodes, response, TABLE_TOLERANCE, len(response))
    return Part("nodal", Linear().fit(np.eye(len(response)), basis.encode(response)), basis)


def _judged(name: str, model: Learned, loads: Loads, truth: np.ndarray, nodes: np.ndarray) -> tuple[Learned, Score]:
    worst = np.sort(errors(model, loads, truth, nodes).max(axis=1))
    rank = min(len(worst), int(np.ceil(COVERAGE * (len(worst) + 1))))
    bounded = Learned(model.anatomy, model.parts, model.envelope, float(worst[rank - 1]), model.training)
    return bounded, score(name, bounded, loads, truth, nodes)


def _pushed(loads: Loads) -> Pushed:
    pushed = loads.of(Pushed)
    if pushed is None or len(loads.causes) > 1:
        raise InputError("the data holds other loads than `Pushed`, which the learners do not take: simulate pushes.")
    return pushed
