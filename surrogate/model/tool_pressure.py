"""How hard a rigid tool presses on the cortex, where a model of its poses has found the forces of contact."""

from __future__ import annotations

import numpy as np

from sim.deformation import Deformation
from sim.errors import InputError
from sim.geometry.surface import vertex_areas
from sim.loads import Loads

from ..data.cortex_patch import open_patch
from ..data.encode import ENCODERS
from ..regressors.rigid_contact import Contact
from .contact_start import HELD
from .learned import Learned, Part


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
