"""Trained model with FEM fallback: FEM solves the loads for which the model's error bound is too large."""

from dataclasses import dataclass, replace

import numpy as np

from sim.anatomy import Anatomy
from sim.deformation import Cost, Deformation, Deformer, Outcome, join_deformations
from sim.errors import InputError
from sim.geometry.surface import compute_vertex_areas
from sim.loads import Loads

from ..data.cortex_patch import open_patch
from ..data.encode import ENCODERS
from ..regressors.rigid_contact import RigidContact
from .held_out import MAX_VERTEX_ERROR, ReportedErrors, find_fem_fallback
from .learned import Learned, ModelPart
from .tool_contact import CONTACT_KEY


@dataclass(frozen=True, eq=False)
class Guarded:
    """`Deformer` that uses the model where its bound is small enough, and FEM elsewhere.

    Parameters
    ----------
    model
        Trained model, which is evaluated first for all loads.
    fem
        FEM with the model's anatomy, effects and element. It solves loads that the model marks as extrapolated, loads
        without a bound, and loads whose bound is above the limit.
    limit
        Limit [m] of the bound on the maximum error over the tumour's vertices, with probability 0.95.

    Raises
    ------
    InputError
        The model's tissue relaxes: FEM would need all earlier frames, also those that it did not solve.
    """

    model: Learned
    fem: Deformer
    limit: float = MAX_VERTEX_ERROR

    def __post_init__(self) -> None:
        if self.model.series:
            raise InputError(
                "the model follows tissue that relaxes, and FEM fallback would need every earlier frame: "
                "use one of them alone."
            )

    @property
    def anatomy(self) -> Anatomy:
        """Anatomy of the model."""
        return self.model.anatomy

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        """Solve `loads`, and return the deformation at the mesh vertices `at` (n,) (default: the model's vertices).

        If FEM solves every load and `at` is not given, the result has every mesh vertex. FEM starts from `start` if
        that has every vertex, else from the undeformed configuration. If FEM finds no equilibrium, the model's result
        and bound are kept.

        Raises
        ------
        InputError
            The model rejects the loads or the start.
        """
        predicted = self.model.deform(loads, start, at)
        unsure = np.flatnonzero(self.find_unreliable(predicted))
        if not len(unsure):
            return predicted
        whole = start is not None and len(start.nodes) == len(self.anatomy.mesh.nodes)
        solved = self.fem.deform(loads.select(unsure), start.select(unsure) if start is not None and whole else None)
        good = np.array([outcome.good for outcome in solved.outcome])
        if at is None and good.all() and len(unsure) == len(loads):
            return solved
        pushed = self.model.tool is None
        return _replace_rows(predicted, unsure[good], solved.select(np.flatnonzero(good)), pushed)

    def find_unreliable(self, predicted: Deformation) -> np.ndarray:
        """Return the mask (B,) of the predictions that FEM must replace."""
        bound = np.where(np.isnan(predicted.bound[0]), self.model.bound, predicted.bound[0])
        return find_fem_fallback(bound, np.array([not outcome.good for outcome in predicted.outcome]), self.limit)

    unsure = find_unreliable  # Former names, for one release.


def get_reported_errors(model: Learned) -> ReportedErrors:
    """Return the errors on held-out cortex that a model reports."""
    return ReportedErrors(model.bound, model.held_out)


def describe_error(model: Learned) -> str:
    """Describe a model's errors on held-out cortex, and state if scenes use the model with FEM fallback."""
    stated = get_reported_errors(model)
    guarded = "scenes play it without FEM, as its tissue relaxes" if model.series else "scenes play it guarded"
    return f"{model.held_out or stated}: {guarded if stated.is_weak else 'scenes play it without FEM'}"


def find_model(deformer: Deformer) -> Learned | None:
    """Return the trained model that a deformer consists of or evaluates first; None for FEM."""
    if isinstance(deformer, Guarded):
        return deformer.model
    return deformer if isinstance(deformer, Learned) else None


def find_first_model(deformer: Deformer, result: Deformation) -> Learned | None:
    """Return the trained model that computed load case 0 of a deformer's result; None if FEM computed it."""
    return find_model(deformer) if result.outcome[0] in (Outcome.PREDICTED, Outcome.EXTRAPOLATED) else None


def _replace_rows(predicted: Deformation, rows: np.ndarray, solution: Deformation, keeps_reaction: bool) -> Deformation:
    """Replace `rows` (k,) of predictions by the k FEM solutions; if `keeps_reaction`, the reactions are not replaced.

    If the model does not predict the reaction of a pose, the reaction is not available in any row.
    """
    pick = np.arange(len(predicted))
    pick[rows] = len(predicted) + np.arange(len(rows))
    ours = replace(predicted, cost=Cost({"predict": predicted.cost.total, "solve": 0.0}))
    theirs = solution.restrict(predicted.nodes)
    cost = Cost({"predict": 0.0, "solve": solution.cost.total})
    known = solution.reaction.shape[1] == predicted.reaction.shape[1] and not keeps_reaction
    theirs = replace(theirs, reaction=theirs.reaction if known else predicted.reaction[rows], cost=cost)
    source = predicted.source
    if len(rows):
        source += f"; for {len(rows)} of {len(predicted)} loads {solution.source}"
    return replace(join_deformations([ours, theirs]).select(pick), source=source)


def compute_tool_pressure(model: Learned, loads: Loads, result: Deformation) -> np.ndarray:
    """Compute the tool's mean pressure (B, k) [Pa] at the k vertices of the open cortex: nodal force / nodal area.

    Contact forces are computed on linear tissue and scaled so that their sum is the model's tool force. A nodal area is
    a third of the area of the adjacent deformed triangles, as in `sim.contact_pressure.compute_pressure`.

    Parameters
    ----------
    result
        Result of `model` for the loads, at all vertices of the model.

    Raises
    ------
    InputError
        The model has no contact part or no force model, or the result has another size.
    """
    part = _find_contact(model)
    if part is None:
        raise InputError("this model knows no forces of contact: train the learner contact or contact-gp on poses.")
    if result.displacement.shape[:2] != (len(loads), len(model.nodes)):
        raise InputError(
            f"the result has {len(result)} load cases at {len(result.nodes)} vertices, the loads have {len(loads)} and "
            f"the model {len(model.nodes)}: give the complete result for these loads."
        )
    patch, mesh, contact = open_patch(model.anatomy), model.anatomy.mesh, part.regressor
    assert isinstance(contact, RigidContact)
    held = result.warm.get(CONTACT_KEY)
    if held is None:
        held = contact.compute_warm_start(ENCODERS[part.encoder](patch, model.clip_to_range(model.to_input(loads))[1]))
    force = contact.get_warm_start_force(held).reshape(len(loads), -1, 3)
    whole = np.linalg.norm(force.sum(axis=1), axis=1)
    size = np.linalg.norm(result.reaction[:, 0, :3], axis=1)
    factor = np.divide(size, whole, out=np.zeros_like(size), where=whole > 0.0)
    touchable = np.unique(mesh.surface[model.anatomy.bare])
    nodes = np.tile(mesh.nodes, (len(loads), 1, 1))
    nodes[:, result.nodes] += result.displacement
    area = np.stack([compute_vertex_areas(each, mesh.surface)[touchable] for each in nodes])
    return factor[:, None] * np.linalg.norm(force, axis=2) / area


def has_tool_pressure(model: Learned) -> bool:
    """Return True if a model has the contact part and force model that `compute_tool_pressure` needs."""
    return _find_contact(model) is not None


def _find_contact(model: Learned) -> ModelPart | None:
    if model.force is None:
        return None
    return next((part for part in model.parts if isinstance(part.regressor, RigidContact)), None)
