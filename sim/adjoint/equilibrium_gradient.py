"""Derivative of a reading of the displacement with respect to loads and tissue, by one adjoint solve.

With the equilibrium g(u, p) = 0, its tangent stiffness K = dg/du and a reading L(u), the implicit function theorem
gives

    dL/dp = -v . dg/dp,   K v = dL/du.

K is symmetric, so the adjoint solution v costs one linear solve for any number of parameters p: Errico 1997, "What is
an adjoint model?", Bull. Am. Meteorol. Soc. 78:2577-2591.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..arguments import check_numbers_array
from ..compile import ElasticPart, collect_laws, compile_problem, list_elastic_parts
from ..deformation import Deformation
from ..discretisation.term import Cases, StrainTerm
from ..effects import Elasticity, Inertia
from ..errors import InputError
from ..fem import Fem
from ..linalg.pcg import solve_conjugate_gradients
from ..loads import Loads
from ..runtime.columns import compute_norms
from .load_gradient import differentiate_loads, iterate_load_slopes
from .tissue_gradient import (
    STENCIL,
    STEP,
    Regions,
    add_barrier_work,
    find_parameter,
    spread_over_tetrahedra,
    sum_by_region,
)

TOLERANCE = {"float32": 1e-5, "float64": 1e-10}  # Relative residual of the adjoint solve, by precision.
MAX_ITERATIONS = 3000  # Maximum number of conjugate gradient iterations of the adjoint solve.


@dataclass(frozen=True, eq=False)
class EquilibriumGradient:
    """Derivatives of a reading of the displacement, for B load cases.

    Parameters
    ----------
    causes
        For each cause of the loads, derivatives with respect to its arrays, by name and in their shapes. `pose` is the
        exception: (B, tools, 6) by translation [m] and rotation [rad] about the axes of the mesh and the tool's origin.
    regions
        Derivatives (B,) by region label and parameter: `young`, `poisson`, and Ogden's "c1", "m1", ... and `bulk`.
    adjoint
        Adjoint solution (B, N, 3): the derivative with respect to a force at each node.
    """

    causes: tuple[Mapping[str, np.ndarray], ...]
    regions: Regions
    adjoint: np.ndarray
    _fem: Fem
    _parts: tuple[ElasticPart, ...]
    _work: tuple[np.ndarray, ...]

    def compute_by_tetrahedron(self, name: str) -> np.ndarray:
        """Return derivatives (B, T) with respect to a parameter of each tetrahedron's tissue, such as `young`.

        Raises
        ------
        InputError
            No tissue has the parameter.
        """
        known = sorted({key for row in self.regions.values() for key in row})
        if name not in known:
            raise InputError(f"no tissue has a parameter {name!r}: choose one of {', '.join(known)}.")
        space = self._fem.space
        return spread_over_tetrahedra(self._parts, self._work, space.mesh, space.element, name)


def differentiate_equilibrium(
    fem: Fem, loads: Loads, deformation: Deformation, seed: np.ndarray, start: Deformation | None = None
) -> EquilibriumGradient:
    """Return the derivatives of sum(seed * displacement) with respect to loads and tissue, for each load case.

    The derivative of any function of the displacement follows with its own derivative as `seed`.

    Parameters
    ----------
    fem
        Solver of the equilibrium; its precision is that of the derivatives.
    loads
        Loads of the equilibrium.
    deformation
        Equilibrium at all mesh vertices, as returned by `fem.deform`; its residual adds to the error.
    seed
        Derivative (B, V, 3) of the reading with respect to the displacement of every mesh vertex.
    start
        Start of the equilibrium if tissue relaxes: its history variables are kept constant. None: the undeformed state.

    Raises
    ------
    InputError
        A load case has no equilibrium, or an unstable one. The effects include inertia or a resection, the element is
        not p1, smoothed or p2, `seed` has another shape, or the adjoint solve does not converge.

    Examples
    --------
    >>> from scenes import get_template_path
    >>> from sim import BRAIN, Fem, build_push_effects, differentiate_equilibrium, open_cortex, push, read_anatomy
    >>> anatomy = read_anatomy(get_template_path())
    >>> place = open_cortex(anatomy).place()
    >>> fem = Fem(anatomy, build_push_effects(anatomy, BRAIN), device="cpu", element="p1")
    >>> loads = push(place.point, 0.1 * place.inward, footprint=7e-3)
    >>> seed = np.zeros((1, len(anatomy.mesh.nodes), 3))
    >>> seed[:, anatomy.tumour_nodes] = place.inward / len(anatomy.tumour_nodes)  # mean motion of the tumour
    >>> found = differentiate_equilibrium(fem, loads, fem.deform(loads), seed)
    >>> print(f"{1e3 * found.causes[0]['force'][0] @ place.inward:.1f} mm/N")
    2.9 mm/N
    """
    _check_solver(fem)
    with fem.lock:
        return _differentiate(fem, loads, deformation, seed, start)


def compute_jacobian(
    fem: Fem,
    loads: Loads,
    deformation: Deformation,
    parameters: Sequence[tuple[int, str]] = (),
    arrays: Sequence[tuple[int, str]] = (),
    start: Deformation | None = None,
) -> np.ndarray:
    """Return the derivatives (n, B, V, 3) of the displacement with respect to n numbers (forward mode).

    Each number costs one linear solve. For many numbers and one reading, `differentiate_equilibrium` is faster. The
    other parameters are as there.

    Parameters
    ----------
    parameters
        Region label and parameter of tissue, such as (1, "young").
    arrays
        Number of a cause in `loads.causes` and one of its arrays, such as (0, "force"); each component is a number. Not
        available for `Nodal`, `Prescribed`, `Displaced` and `Resected`.

    Raises
    ------
    InputError
        A region, parameter, cause or array is unknown; see also `differentiate_equilibrium`.
    """
    _check_solver(fem)
    with fem.lock:
        cases, u = _linearise(fem, loads, deformation, start)
        vertices = len(fem.anatomy.mesh.nodes)
        effect = next(effect for effect in fem.effects if isinstance(effect, Elasticity))
        laws = collect_laws(effect, np.unique(fem.anatomy.mesh.region).tolist())
        device, slopes = replace(fem.problem.device, precision="float64"), []  # differences need all digits
        state = device.upload(u)
        for label, name in parameters:
            value, change = find_parameter(laws, label, name)
            step, slope = STEP * (abs(value) or 1.0), np.zeros(u.shape)
            for offset, weight in STENCIL:
                laws_now = laws | {label: change(laws[label], value + offset * step)}
                effects = [Elasticity(None, laws_now) if one is effect else one for one in fem.effects]
                other = compile_problem(effects, fem.anatomy, device, fem.space)
                other.begin(cases)
                slope += weight / step * other.gradient(state).numpy()
            slopes.append(slope)
        at = fem.problem.device.upload(u)
        for number, name in arrays:
            slopes += iterate_load_slopes(fem.problem, cases, number, name, at)
        fem.problem.linearise(at, np.zeros(len(loads), bool))
        return np.array([_solve(fem, -slope)[0].T.reshape(len(loads), -1, 3)[:, :vertices] for slope in slopes])


def _check_solver(fem: Fem) -> None:
    if not isinstance(fem, Fem):
        raise InputError(f"{type(fem).__name__} has no derivatives: give a Fem, whose effects contain no Resection.")


def _differentiate(
    fem: Fem, loads: Loads, deformation: Deformation, seed: np.ndarray, start: Deformation | None
) -> EquilibriumGradient:
    problem, space, vertices = fem.problem, fem.space, len(fem.anatomy.mesh.nodes)
    seed = check_numbers_array("seed", seed)
    if seed.shape != (len(loads), vertices, 3):
        raise InputError(f"seed has shape {seed.shape}: give {(len(loads), vertices, 3)}.")
    cases, u = _linearise(fem, loads, deformation, start)
    whole = np.zeros((len(loads), space.count, 3))
    whole[:, :vertices] = seed
    adjoint, unbalanced = _solve(fem, whole.reshape(len(loads), -1).T)
    effect = next(effect for effect in fem.effects if isinstance(effect, Elasticity))
    parts = tuple(list_elastic_parts(effect, space))
    terms = [term for term in problem.terms if isinstance(term, StrainTerm)][: len(parts)]
    work = tuple(-term.compute_coefficient_work(u, adjoint) for term in terms)
    regions = sum_by_region(parts, work)
    if problem.barriers:
        pressed = problem.device.allocate(*u.shape)
        for barrier in problem.barriers:
            barrier.add_gradient(problem.device.upload(u), pressed)
        add_barrier_work(regions, parts, np.einsum("nb,nb->b", adjoint, pressed.numpy().astype(np.float64)))
    causes = differentiate_loads(problem, space, cases, u, adjoint, unbalanced)
    by_node = adjoint.T.reshape(len(loads), space.count, 3)
    return EquilibriumGradient(causes, regions, by_node, fem, parts, work)


def _linearise(fem: Fem, loads: Loads, deformation: Deformation, start: Deformation | None) -> tuple[Cases, np.ndarray]:
    """Set the solver's problem to the equilibrium and linearise it there; return the cases, and u (3N, b) [m]."""
    if any(isinstance(effect, Inertia) for effect in fem.effects):
        raise InputError("a time step under Inertia has no equilibrium to differentiate: remove Inertia.")
    if fem.space.element not in ("p1", "smoothed", "p2"):
        raise InputError(f"derivatives are not available for {fem.space.element}: choose p1, smoothed or p2.")
    bad = [row for row, outcome in enumerate(deformation.outcome) if not outcome.good]
    if bad:
        raise InputError(f"load {bad[0]} is {deformation.outcome[bad[0]].value}: only equilibria have derivatives.")
    cases = Cases(loads, np.zeros(len(loads))) if start is None else Cases(loads, start.time, start.memory)
    fem.problem.begin(cases)
    u = fem.guess(loads, deformation)
    fem.problem.linearise(fem.problem.device.upload(u), np.zeros(len(loads), bool))
    return cases, u


def _solve(fem: Fem, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the solution v (3N, b) of K v = force at free nodes, and force - K v, which is zero there.

    Raises
    ------
    InputError
        The stiffness is not positive definite, or the iteration limit is reached.
    """
    problem, device, columns = fem.problem, fem.problem.device, force.shape[1]
    right = device.upload(force)
    problem.constraint.project(right)
    preconditioner = fem.strategy.preconditioner
    preconditioner.prepare(problem, columns)
    wanted = TOLERANCE[device.precision] * compute_norms(device, right)
    found = solve_conjugate_gradients(problem, preconditioner, right, wanted, MAX_ITERATIONS)
    if found.truncated.any():
        raise InputError(f"the equilibrium of load {np.argmax(found.truncated)} is unstable: it has no derivative.")
    left = compute_norms(device, right) > 10.0 * wanted
    if left.any():
        raise InputError(f"the linear solve of load {np.argmax(left)} did not converge in {MAX_ITERATIONS} iterations.")
    product = device.allocate(*force.shape)
    problem.add_curvature(found.x, product)
    return found.x.numpy().astype(np.float64), force - product.numpy()
