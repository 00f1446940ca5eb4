"""Tables computed by FEM: contact compliance of the nodes that a tool may touch, and power series on the cortex."""

from collections.abc import Callable

import numpy as np
from scipy.linalg import block_diag

from sim.fem import Fem
from sim.geometry.surface import compute_edge_lengths
from sim.loads import Loads, Pushed
from sim.minimisers.power_series import OutputFunctionals
from sim.runtime.journal import Journal
from sim.tools import Ball, BuiltIn, get_core

from ..array_functions import compute_squared_distances
from ..data.cortex_patch import Patch
from ..data.encode import Basis, fit_basis
from ..regressors.force_series import FACTORS, MAX_ORDER, STENCIL_SIZE, TERM_COUNT
from ..regressors.rigid_contact import RigidContact

STRIP_NODES = 64  # Number of nodes whose unit responses are computed together: limits memory.
BASIS_TOLERANCE = 1e-4  # Truncation tolerance of a basis, as a share of the unit responses.


def condense_contact(
    fem: Fem, parts: list[np.ndarray], tool: BuiltIn | None = None
) -> tuple[RigidContact, list[Basis]]:
    """Condense an undeformed body to the nodes that a tool may touch; return the contact and a basis for each part.

    `parts` are vertex sets (n,). Without `tool`, the tool is a ball with the radius in the features. The contact
    returns the coefficients of all bases, one basis after the other.
    """
    surface = fem.anatomy.mesh.surface[fem.anatomy.bare]
    nodes, triangles = np.unique(surface, return_inverse=True)
    response = compute_unit_responses(fem, nodes, np.concatenate([nodes, *parts]))
    compliance, *answers = np.split(response, np.cumsum([len(nodes), *map(len, parts[:-1])]), axis=1)
    bases = [fit_basis(some, each, BASIS_TOLERANCE, len(each)) for some, each in zip(parts, answers, strict=True)]
    coefficients = np.hstack([basis.encode(each) for basis, each in zip(bases, answers, strict=True)])
    rows = 3 * len(nodes)
    contact = RigidContact(
        fem.anatomy.mesh.nodes[nodes],
        triangles,
        compliance.reshape(rows, rows),
        coefficients,
        np.repeat([[1.0], [0.0]], coefficients.shape[1], axis=1),
        core=np.zeros(0) if tool is None or isinstance(tool, Ball) else _get_sizes(tool),
    )
    return contact, bases


def _get_sizes(tool: BuiltIn) -> np.ndarray:
    """Return the half sizes of a tool's core and its radius (4,) [m]."""
    core = get_core(tool)
    return np.append(core.half, core.radius)


def join_bases(bases: list[Basis]) -> Basis:
    """Combine bases of disjoint vertex sets into one basis, with the modes of each."""
    modes = np.asarray(block_diag(*(basis.modes for basis in bases)))
    return Basis(np.concatenate([basis.nodes for basis in bases]), modes)


def compute_unit_responses(fem: Fem, nodes: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Compute displacements (3 n, k, 3) float32 [m/N] of `vertices` (k,) under unit forces on `nodes` (n,)."""
    found = []
    for first in range(0, len(nodes), STRIP_NODES):
        some = nodes[first : first + STRIP_NODES]
        answers = fem.build_reading(some, np.eye(3 * len(some)).reshape(-1, len(some), 3)).solutions
        found.append(answers.reshape(len(answers), -1, 3)[:, vertices].astype(np.float32))
    return np.concatenate(found)


MAX_RADIUS_RATIO = 1.5  # Maximum ratio of neighbouring tabulated radii.


def choose_radii(min_radius: float, max_radius: float) -> np.ndarray:
    """Compute footprint radii [m] to tabulate, geometric from `min_radius` to `max_radius`: one, or at least three."""
    if max_radius <= min_radius * (1.0 + 1e-9):
        return np.array([min_radius])
    steps = int(np.ceil(np.log(max_radius / min_radius) / np.log(MAX_RADIUS_RATIO)))
    return np.geomspace(min_radius, max_radius, max(STENCIL_SIZE, steps + 1))


def tabulate_series(
    fem: Fem, positions: np.ndarray, radii: np.ndarray, projection: OutputFunctionals,
    progress: Callable[[int, int], object] = lambda done, total: None, journal: Journal | None = None,
) -> np.ndarray:  # fmt: skip
    """Compute power series coefficients (P, R, 19, r) float32 at `positions` (P, 3) [m] for footprint `radii` (R,) [m].

    `projection` projects each response on r modes. `progress` receives the number of positions done and their total.
    Positions in the `journal` are not solved again.
    """
    table = np.empty((len(positions), len(radii), TERM_COUNT, projection.count), np.float32)
    some = max(1, fem.batch // (len(radii) * FACTORS[-1].shape[1]))
    left = []
    for number, row in enumerate(table):
        if journal is None or ("row", number) not in journal:
            left.append(number)
        else:
            row[:] = np.frombuffer(journal.read(("row", number)), table.dtype).reshape(row.shape)
    for first in range(0, len(left), some):
        rows = left[first : first + some]
        here = positions[rows]
        point = np.repeat(here, 3 * len(radii), axis=0)
        force = np.tile(np.eye(3), (len(here) * len(radii), 1))
        loads = Loads((Pushed(point, force, np.tile(np.repeat(radii, 3), len(here))),))
        table[rows] = fem.compute_series(loads, MAX_ORDER, projection, 3).reshape(len(here), *table.shape[1:])
        if journal is not None:
            for number in rows:
                journal.add(("row", number), table[number].tobytes())
        progress(len(positions) - len(left) + first + len(here), len(positions))
    return table


def find_disc_nodes(patch: Patch, radius: float) -> np.ndarray:
    """Return the mask (m, m) of node pairs that one disc of `radius` [m], or adjacent triangles, may load at once.

    More distant nodes, whose triangles extend into a disc, are excluded: they contribute 1 in 100,000 of the tumour's
    motion.
    """
    longest = compute_edge_lengths(patch.points[patch.triangles]).max()
    return compute_squared_distances(patch.points, patch.points) <= (2.0 * max(radius, longest)) ** 2


def add_edge_midpoints(patch: Patch) -> tuple[np.ndarray, np.ndarray]:
    """Build triangles (S, 6): corners, then midpoints of the opposite edges; return them and positions (P, 3) [m]."""
    edges = np.sort(patch.triangles[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)
    ends, middle = np.unique(edges, axis=0, return_inverse=True)
    triangles = np.column_stack([patch.triangles, len(patch.points) + middle.reshape(-1, 3)])
    return triangles, np.concatenate([patch.points, patch.points[ends].mean(axis=1)])
