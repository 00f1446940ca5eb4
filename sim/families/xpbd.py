"""Extended position-based dynamics (XPBD) of a mass-spring model, with a fixed number of iterations, as in games.

Macklin, Muller, Chentanez 2016, "XPBD: position-based simulation of compliant constrained dynamics", equations 17 and
18. The constraints are the springs and the volumes of `laws.springs`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from ..compile import collect_laws
from ..discretisation.element import build_linear_elements
from ..discretisation.problem import Problem
from ..discretisation.space import Discretisation
from ..effects import Elasticity
from ..geometry.tetmesh import EDGES
from ..runtime.device import forward_kernel
from ..runtime.views import run_in_order, to_library, to_view
from ..terms.laws.invariants import cofactor_matrix
from ..terms.laws.springs import compute_spring_coefficients
from .linear_body import list_fixed_vertices
from .models import Relaxation


@dataclass(frozen=True)
class Substeps:
    """Options of the time steps.

    Parameters
    ----------
    count, iterations
        Number of time steps, and number of iterations in each step.
    step
        Duration of a step [s].
    velocity_factor
        Fraction of the velocity that remains after a step.
    density
        Density of the tissue [kg/m^3].
    """

    count: int = 200
    iterations: int = 1
    step: float = 1e-3
    velocity_factor: float = 0.95
    density: float = 1040.0


@wp.func
def get_displacement(u: wp.array2d(dtype=wp.float64), node: int, c: int):
    """Return the displacement [m] of a node in load case c."""
    return wp.vec3d(u[3 * node, c], u[3 * node + 1, c], u[3 * node + 2, c])


@wp.func
def add_displacement(u: wp.array2d(dtype=wp.float64), node: int, c: int, increment: wp.vec3d):
    """Add `increment` [m] to the displacement of a node in load case c."""
    for k in range(3):
        u[3 * node + k, c] += increment[k]


@forward_kernel
def solve_constraints(
    order: wp.array(dtype=wp.int32),
    elements: wp.array2d(dtype=wp.int32),
    ends: wp.array2d(dtype=wp.int32),
    nodes: wp.array(dtype=wp.vec3d),
    gradient: wp.array2d(dtype=wp.vec3d),
    inverse: wp.array(dtype=wp.float64),
    compliance: wp.array2d(dtype=wp.float64),
    # outputs
    u: wp.array2d(dtype=wp.float64),
    multiplier: wp.array3d(dtype=wp.float64),
):
    """Update the multipliers m and the positions for the constraints C of a tetrahedron: six lengths and one volume.

    dm = (-C - a m) / (sum of w |grad C|^2 + a) and dx = w grad C dm, where a is compliance / (time step)^2.
    """
    t, c = wp.tid()
    e = order[t]
    for k in range(6):
        i = int(elements[e, ends[k, 0]])
        j = int(elements[e, ends[k, 1]])
        L = nodes[j] - nodes[i]
        l = L + get_displacement(u, j, c) - get_displacement(u, i, c)
        size = wp.length(l)
        a = compliance[e, k]
        w = inverse[i] + inverse[j]
        if w > wp.float64(0.0) and size > wp.float64(0.0):
            change = -(size - wp.length(L) + a * multiplier[e, k, c]) / (w + a)
            multiplier[e, k, c] += change
            add_displacement(u, i, c, -(inverse[i] * change / size) * l)
            add_displacement(u, j, c, (inverse[j] * change / size) * l)
    F = wp.identity(n=3, dtype=wp.float64)
    for k in range(4):
        F += wp.outer(get_displacement(u, elements[e, k], c), gradient[e, k])
    cof = cofactor_matrix(F)
    total = compliance[e, 6]
    for k in range(4):
        total += inverse[elements[e, k]] * wp.length_sq(cof * gradient[e, k])
    step = -(wp.determinant(F) - wp.float64(1.0) + compliance[e, 6] * multiplier[e, 6, c]) / total
    multiplier[e, 6, c] += step
    for k in range(4):
        i = int(elements[e, k])
        add_displacement(u, i, c, inverse[i] * step * (cof * gradient[e, k]))


def build_solver(
    problem: Problem, space: Discretisation, tissue: Elasticity, settings: Substeps = Substeps()
) -> Callable[[int], tuple[wp.array, int]]:
    """Return a solver: a function of the number b of load cases that returns displacements (3N, b) [m] and iterations.

    Raises
    ------
    InputError
        A vertex is fixed in some directions only.
    """
    device, mesh = problem.device, space.mesh
    elements = build_linear_elements(mesh, np.ones(len(mesh.tets), bool))
    laws, region = collect_laws(tissue, np.unique(mesh.region).tolist()), mesh.region.tolist()
    numbers = compute_spring_coefficients(np.array([laws[label].lame for label in region]), elements.gradient)
    mass = np.bincount(mesh.tets.ravel(), np.repeat(0.25 * settings.density * mesh.volumes, 4), len(mesh.nodes))
    free = ~list_fixed_vertices("xpbd", problem) & (mass > 0.0)
    inverse = np.where(free, 1.0 / np.maximum(mass, 1e-12), 0.0)
    stiffness = mesh.volumes[:, None] * np.column_stack([np.repeat(numbers[:, :1], 6, axis=1), numbers[:, 1]])
    inputs = [
        device.upload(mesh.tets, wp.int32),
        device.upload(EDGES, wp.int32),
        device.upload(mesh.nodes, device.vector),
        device.upload(elements.gradient[:, 0], device.vector),
        device.upload(inverse),
        device.upload(1.0 / (np.maximum(stiffness, 1e-12) * settings.step**2)),
    ]
    colours = [device.upload(tets, wp.int32) for tets in group_tetrahedra(mesh.tets)]

    def relax(count: int) -> tuple[wp.array, int]:
        """Predict positions by u += kept (u - u_previous) + h^2 a, then solve the constraints, in every step."""
        u, before = device.allocate(problem.rows, count), device.allocate(problem.rows, count)
        multiplier, (x, old) = device.allocate(len(mesh.tets), 7, count), map(to_view, (u, before))
        with run_in_order(device):
            moved = (
                -(settings.step**2) * to_library(device, np.repeat(inverse, 3)[:, None]) * to_view(problem.gradient(u))
            )
        for _ in range(settings.count):
            with run_in_order(device):
                old[:], x[:] = x, x + settings.velocity_factor * (x - old) + moved
            multiplier.zero_()
            for order in settings.iterations * colours:
                device.launch(solve_constraints, (len(order), count), [order, *inputs], [u, multiplier])
        return u, settings.count * settings.iterations

    return relax


def group_tetrahedra(tets: np.ndarray) -> list[np.ndarray]:
    """Return groups of tetrahedra without common vertices, by greedy colouring of the tetrahedra (T, 4)."""
    used = np.zeros(tets.max() + 1, object)
    colour = np.empty(len(tets), int)
    for number, nodes in enumerate(tets.tolist()):
        taken = used[nodes[0]] | used[nodes[1]] | used[nodes[2]] | used[nodes[3]]
        lowest = int(~taken & (taken + 1))
        colour[number] = lowest.bit_length() - 1
        used[nodes] |= lowest
    return [np.flatnonzero(colour == each) for each in range(colour.max() + 1)]


XPBD = Relaxation("springs", build_solver, tolerance=1e-2)
