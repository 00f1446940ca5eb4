"""Contact pressure of tools and skull on the tissue surface."""

import numpy as np

from .deformation import Deformation
from .discretisation.term import Cases
from .errors import InputError
from .fem import Fem
from .geometry.surface import compute_vertex_areas
from .loads import Loads


def compute_pressure(fem: Fem, loads: Loads, answer: Deformation) -> np.ndarray:
    """Return the contact pressure (B, V) [Pa] of tools and a separable skull at each vertex: nodal force / nodal area.

    The nodal area is one third of the adjacent deformed surface triangles; the pressure of interior vertices is 0.
    The tools have the poses that they have at the end of the solution `answer`.

    Raises
    ------
    InputError
        There is no contact effect, or elements are quadratic, so that nodal forces do not give pressures. The solution
        belongs to other loads, or does not contain all vertices.
    """
    if not fem.problem.barriers:
        raise InputError("nothing touches this body: add ToolContact, Retraction or SkullContact to read a pressure.")
    if fem.space.table.shape[1] > 4:
        raise InputError("a pressure is read from linear tetrahedra: make the solver with p1 or smoothed elements.")
    count = fem.space.count
    if answer.displacement.shape != (len(loads), count, 3):
        raise InputError(
            f"the solution has {len(answer)} load cases at {len(answer.nodes)} vertices, the loads have {len(loads)}, "
            f"and the body {count}: give the solution of these loads at all vertices."
        )
    device, surface = fem.problem.device, fem.space.surface
    with fem.lock:
        fem.problem.begin(Cases(loads, answer.time, answer.memory, share=np.zeros(len(answer))))
        u = device.upload(answer.displacement.reshape(-1, 3 * count).T)
        gradient = device.allocate(*u.shape)
        for term in fem.problem.barriers:
            term.add_gradient(u, gradient)
    force = np.linalg.norm(gradient.numpy().T.reshape(answer.displacement.shape), axis=2)
    area = np.array([compute_vertex_areas(fem.space.nodes + moved, surface) for moved in answer.displacement])
    area = area.reshape(force.shape)
    return np.divide(force, area, out=np.zeros_like(area), where=area > 0.0)
