"""Condensed linear finite elements: compliance between the free surface and other vertices.

Bro-Nielsen, Cotin 1996, "Real-time volumetric deformable models for surgery simulation using finite elements and
condensation", Comput. Graph. Forum 15:57-66.
"""

import numpy as np

from ..anatomy import Anatomy
from ..compile import compile_problem
from ..discretisation.space import discretise
from ..effects import Held
from ..linalg.preconditioner import build_rest_solver
from ..runtime.device import find_device
from .linear_body import LinearBody

TOGETHER = 96  # Right-hand sides that are solved together.


def compute_response(body: LinearBody, nodes: np.ndarray) -> np.ndarray:
    """Return displacements (a, 3, n, 3) [m/N] of vertices `nodes` (n,) under unit forces at `body.loaded` (a,).

    The stiffness of smoothed tetrahedra in the undeformed state is factorised in double precision.
    """
    anatomy, device = body.anatomy, find_device("cpu", "float64")
    fixed = np.repeat(body.fixed[:, None], 3, axis=1)
    held = Anatomy(anatomy.mesh, fixed, np.zeros_like(anatomy.slide_normal), anatomy.craniotomy)
    problem = compile_problem((body.tissue, Held()), held, device, discretise(anatomy.mesh, "smoothed"))
    solver = build_rest_solver(problem)
    loaded, read = ((3 * some[:, None] + np.arange(3)).ravel() for some in (body.loaded, nodes))
    out = np.empty((len(loaded), len(read)))
    for first in range(0, len(loaded), TOGETHER):
        some = loaded[first : first + TOGETHER]
        force = np.zeros((problem.rows, len(some)))
        force[some, np.arange(len(some))] = 1.0
        found = device.allocate(*force.shape)
        solver.apply(device.upload(force), np.ones(len(some), bool), found)
        out[first : first + len(some)] = found.numpy()[read].T
    return out.reshape(len(body.loaded), 3, len(nodes), 3)
