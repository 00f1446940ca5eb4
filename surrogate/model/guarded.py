"""Trained model with FEM fallback: loads with too large an error bound are solved by FEM."""

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
        Model that is evaluated first.
    fem
        FEM of the model's body, effects and element. It solves loads that the model marks as extrapolated, loads
        without a bound, and loads whose bound is above the limit.
    limit
        Limit of the largest error over the tumour's vertices, at 95 % [m].

    Raises
    ------
    InputError
        A model that follows relaxing tissue: FEM would need the frames that it did not solve.
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
        """Solve `loads` at mesh vertices `at` (n,): by default at those of the model.

        If FEM solves every load, and `at` is not given, the result has every vertex. FEM starts from a `start` with
        every vertex, else from the undeformed configuration. If it finds no equilibrium, the model's result and bound
        are kept.

        Raises
        ------
        InputError
            Loads, or a start, that the model rejects.
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
        """Return the mask (B,) of predictions that need FEM."""
        bound = np.where(np.isnan(predicted.bound[0]), self.model.bound, predicted.bound[0])
        return find_fem_fallback(bound, np.array([not outcome.good for outcome in predicted.outcome]), self.limit)

    unsure = find_unreliable  # Former names, for one release.


def get_reported_errors(model: Learned) -> ReportedErrors:
    """Return a model's reported errors on held-out cortex."""
    return ReportedErrors(model.bound, model.held_out)


def describe_error(model: Learned) -> str:
    """Describe a model's reported errors, and the deformer used in scenes: see `Guarded`."""
    stated = get_reported_errors(model)
    guarded = "scenes play it without FEM, as its tissue relaxes" if model.series else "scenes play it guarded"
    return f"{model.held_out or stated}: {guarded if stated.is_weak else 'scenes play it without FEM'}"


def find_model(deformer: Deformer) -> Learned | None:
    """Return the model that a deformer is, or evaluates first; None for FEM."""
    if isinstance(deformer, Guarded):
        return deformer.model
    return deformer if isinstance(deformer, Learned) else None


def find_first_model(deformer: Deformer, result: Deformation) -> Learned | None:
    """Return the model that computed the first result of a deformer; None if FEM did."""
    return find_model(deformer) if result.outcome[0] in (Outcome.PREDICTED, Outcome.EXTRAPOLATED) else None


def _replace_rows(predicted: Deformation, rows: np.ndarray, solved: Deformation, pushed: bool) -> Deformation:
    """Replace some `rows` (k,) of predictions by FEM solutions; the reaction of a push always comes from the load.

    The reaction of a pose is unknown in all rows if the model does not predict it.
    """
    pick = np.arange(len(predicted))
    pick[rows] = len(predicted) + np.arange(len(rows))
    ours = replace(predicted, cost=Cost({"predict": predicted.cost.total, "solve": 0.0}))
    theirs = solved.restrict(predicted.nodes)
    cost = Cost({"predict": 0.0, "solve": solved.cost.total})
    known = solved.reaction.shape[1] == predicted.reaction.shape[1] and not pushed
    theirs = replace(theirs, reaction=theirs.reaction if known else predicted.reaction[rows], cost=cost)
    source = predicted.source
    if len(rows):
        source += f"; for {len(rows)} of {len(predicted)} loads {solved.source}"
    return replace(join_deformations([ours, theirs]).select(pick), source=source)


def compute_tool_pressure(model: Learned, loads: Loads, result: Deformation) -> np.ndarray:
    """Compute the tool's mean pressure (B, k) [Pa] at each vertex of the bare surface: force by area.

    Contact forces are those on linear tissue, scaled so that their sum is the model's predicted force. Areas are thirds
    of the deformed surface's triangles at a vertex, as in `sim.contact_pressure.compute_pressure`.

    Parameters
    ----------
    result
        Result of `model` for the loads, at all its vertices.

    Raises
    ------
    InputError
        A model without a contact part, or without its tool's force; a result of another size.
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
    """Return True if `compute_tool_pressure` is available for a model."""
    return _find_contact(model) is not None


def _find_contact(model: Learned) -> ModelPart | None:
    if model.force is None:
        return None
    return next((part for part in model.parts if isinstance(part.regressor, RigidContact)), None)
