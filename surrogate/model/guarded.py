"""A trained model that hands the loads of which it is not sure enough to the finite elements it learned from."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sim.anatomy import Anatomy
from sim.deformation import Cost, Deformation, Deformer, Outcome, joined
from sim.errors import InputError
from sim.geometry.surface import vertex_areas
from sim.loads import Loads

from ..data.cortex_patch import open_patch
from ..data.encode import ENCODERS
from ..regressors.rigid_contact import Contact
from .learned import Learned, Part
from .left_out import LIMIT, OffBy, handed_over
from .tool_contact import HELD


@dataclass(frozen=True, eq=False)
class Guarded:
    """A `Deformer`: the model where it promises enough, and finite elements where it does not.

    Parameters
    ----------
    model
        What answers first.
    fem
        Finite elements of the model's body, effects and element. They answer loads that the model calls extrapolated,
        of which it promises nothing, or for which its bound is above the limit.
    limit
        Of the worst tumour vertex, at 95 % [m].

    Raises
    ------
    InputError
        A model that follows tissue that relaxes: finite elements would need the frames that they did not answer.
    """

    model: Learned
    fem: Deformer
    limit: float = LIMIT

    def __post_init__(self) -> None:
        if self.model.series:
            raise InputError(
                "the model follows tissue that relaxes, and finite elements behind it would need every frame before: "
                "let one of them answer alone."
            )

    @property
    def anatomy(self) -> Anatomy:
        """The body that is deformed."""
        return self.model.anatomy

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        """Answer `loads` at mesh vertices `at` (n,): by default at those that the model knows.

        Where the finite elements answer every load, and `at` is not given, the answer has every vertex. They start from
        such a `start`, and else from rest. Where they find no equilibrium the model's answer stands, with its bound.

        Raises
        ------
        InputError
            Loads, or a start, that the model refuses.
        """
        predicted = self.model.deform(loads, start, at)
        unsure = np.flatnonzero(self.unsure(predicted))
        if not len(unsure):
            return predicted
        whole = start is not None and len(start.nodes) == len(self.anatomy.mesh.nodes)
        solved = self.fem.deform(loads.rows(unsure), start.rows(unsure) if start is not None and whole else None)
        good = np.array([outcome.good for outcome in solved.outcome])
        if at is None and good.all() and len(unsure) == len(loads):
            return solved
        pushed = self.model.tool is None
        return _replaced(predicted, unsure[good], solved.rows(np.flatnonzero(good)), pushed)

    def unsure(self, predicted: Deformation) -> np.ndarray:
        """(B,) bool: which of the model's answers are not good enough."""
        bound = np.where(np.isnan(predicted.bound[0]), self.model.bound, predicted.bound[0])
        return handed_over(bound, np.array([not outcome.good for outcome in predicted.outcome]), self.limit)


def off_by(model: Learned) -> OffBy:
    """What a model states of its errors on cortex left out of a training."""
    return OffBy(model.bound, model.left_out)


def judged(model: Learned) -> str:
    """How far off that is, in words, and who plays scenes for it: see `Guarded`."""
    stated = off_by(model)
    guarded = "it plays alone nevertheless, as its tissue relaxes" if model.series else "scenes play it guarded"
    return f"{model.left_out or stated}: {guarded if stated.weak else 'it may answer alone'}"


def model_of(deformer: Deformer) -> Learned | None:
    """The model that a deformer is, or asks first; None of finite elements."""
    if isinstance(deformer, Guarded):
        return deformer.model
    return deformer if isinstance(deformer, Learned) else None


def answering(deformer: Deformer, answer: Deformation) -> Learned | None:
    """The model that gave the first answer of a deformer; None if finite elements did."""
    return model_of(deformer) if answer.outcome[0] in (Outcome.PREDICTED, Outcome.EXTRAPOLATED) else None


def _replaced(predicted: Deformation, rows: np.ndarray, solved: Deformation, pushed: bool) -> Deformation:
    """Answers of which some `rows` (k,) are solved; the force of a push is what the load says, whoever answers.

    So is that of a pose unknown in all of them, if the model does not know it.
    """
    pick = np.arange(len(predicted))
    pick[rows] = len(predicted) + np.arange(len(rows))
    ours = replace(predicted, cost=Cost({"predict": predicted.cost.total, "solve": 0.0}))
    theirs = solved.at(predicted.nodes)
    cost = Cost({"predict": 0.0, "solve": solved.cost.total})
    known = solved.reaction.shape[1] == predicted.reaction.shape[1] and not pushed
    theirs = replace(theirs, reaction=theirs.reaction if known else predicted.reaction[rows], cost=cost)
    source = predicted.source
    if len(rows):
        source += f"; for {len(rows)} of {len(predicted)} loads {solved.source}"
    return replace(joined([ours, theirs]).rows(pick), source=source)


def tool_pressure(model: Learned, loads: Loads, answer: Deformation) -> np.ndarray:
    """Mean pressure (B, k) [Pa] of the tool round each vertex that it may touch, of the bare surface: force by area.

    Forces of contact are those on linear tissue, made as large together as the force that the model answers. Areas are
    thirds of the deformed surface's triangles at a vertex, as in `sim.contact_pressure.pressure`.

    Parameters
    ----------
    answer
        What `model` answered the loads with, of all vertices that it knows.

    Raises
    ------
    InputError
        A model without a part of contact, or that does not know its tool's force; an answer of another size.
    """
    part = _contact_of(model)
    if part is None:
        raise InputError("this model knows no forces of contact: train the learner contact or contact-gp on poses.")
    if answer.displacement.shape[:2] != (len(loads), len(model.nodes)):
        raise InputError(
            f"the answer has {len(answer)} load cases at {len(answer.nodes)} vertices, the loads have {len(loads)} and "
            f"the model {len(model.nodes)}: give the whole answer to these loads."
        )
    patch, mesh, contact = open_patch(model.anatomy), model.anatomy.mesh, part.regressor
    assert isinstance(contact, Contact)
    held = answer.warm.get(HELD)
    if held is None:
        held = contact.held(ENCODERS[part.encoder](patch, model.within(model.asked(loads))[1]))
    force = contact.held_force(held).reshape(len(loads), -1, 3)
    whole = np.linalg.norm(force.sum(axis=1), axis=1)
    size = np.linalg.norm(answer.reaction[:, 0, :3], axis=1)
    factor = np.divide(size, whole, out=np.zeros_like(size), where=whole > 0.0)
    touchable = np.unique(mesh.surface[model.anatomy.bare])
    nodes = np.tile(mesh.nodes, (len(loads), 1, 1))
    nodes[:, answer.nodes] += answer.displacement
    area = np.stack([vertex_areas(each, mesh.surface)[touchable] for each in nodes])
    return factor[:, None] * np.linalg.norm(force, axis=2) / area


def knows_pressure(model: Learned) -> bool:
    """Whether `tool_pressure` can be had of a model."""
    return _contact_of(model) is not None


def _contact_of(model: Learned) -> Part | None:
    if model.force is None:
        return None
    return next((part for part in model.parts if isinstance(part.regressor, Contact)), None)
