"""Compilation of effects to a boundary value problem: one `match` statement converts each effect to a term.

The module of a term is imported when an effect needs the term. User-defined effects build their own terms.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import warp as wp

from .anatomy import Anatomy, describe_region
from .discretisation.body import Body
from .discretisation.constraint import Constraint
from .discretisation.element import Elements
from .discretisation.footprint import ContactSurface
from .discretisation.problem import ImposedMotion, Problem
from .discretisation.rigid_modes import check_fixed
from .discretisation.space import Discretisation, discretise
from .discretisation.term import AssembledTerm, Barrier, Term
from .effects import (
    Bonded,
    BuiltIn,
    Effect,
    Elasticity,
    Gravity,
    Held,
    Inertia,
    NodalForce,
    OwnEffect,
    Pulsation,
    Resection,
    Retraction,
    SkullContact,
    Slide,
    ToolContact,
    ToolDisplacement,
    ToolForce,
)
from .errors import InputError
from .loads import (
    Displaced,
    Loads,
    Nodal,
    Posture,
    Prescribed,
    Pushed,
    Resected,
    Retracted,
    Touching,
    check_field,
    check_loads,
)
from .material import Tissue, build_functions, collect_coefficients, get_lame
from .runtime.device import Device

CAUSES = {
    ToolForce: Pushed,
    ToolDisplacement: Displaced,
    NodalForce: Nodal,
    Held: Prescribed,
    Gravity: Posture,
    Resection: Resected,
    ToolContact: Touching,
    Retraction: Retracted,
}
"""Load cause that each effect requires; effects that are not listed act without a load."""


def compile_problem(
    effects: Iterable[Effect],
    anatomy: Anatomy,
    device: Device,
    space: Discretisation | None = None,
    surface: ContactSurface | None = None,
) -> Problem:
    """Return the boundary value problem with the terms and constraints of `effects`, by default on linear tetrahedra.

    `surface` is the contact surface of `space`, if the caller has already built it.

    Raises
    ------
    InputError
        An effect is unknown or duplicate, no effect resists deformation, a region has no law, or the body is not fixed.
        A user-defined effect does not return a term, or its name is already in use.
    """
    effects, space = _check_compatible(effects), space or discretise(anatomy.mesh, "p1")
    surface = surface or ContactSurface(space.nodes, space.surface, device)
    terms: list[Term] = []
    own: list[Term] = []
    barriers: list[Barrier] = []
    fixed, normal = np.zeros_like(anatomy.fixed), np.zeros_like(anatomy.slide_normal)
    pulsation = next((effect for effect in effects if isinstance(effect, Pulsation)), None)
    for effect in effects:
        match effect:
            case Elasticity():
                terms += _build_elasticity(effect, space, device, pulsation=pulsation)
            case Held():
                fixed = fixed | anatomy.fixed
            case Bonded():
                fixed = fixed | (anatomy.slide_normal != 0.0).any(axis=1)[:, None]
            case Slide():
                normal = anatomy.slide_normal
            case ToolForce():
                from .terms.dead_force import DeadForce, build_pushed_forces

                terms.append(DeadForce("tool force", partial(build_pushed_forces, surface, device), device))
            case NodalForce():
                from .terms.dead_force import DeadForce, build_nodal_forces

                build = partial(build_nodal_forces, len(anatomy.mesh.nodes), device)
                terms.append(DeadForce("nodal force", build, device))
            case Gravity():
                from .terms.gravity import build_gravity_term

                terms.append(build_gravity_term(effect, space, device))
            case Inertia():
                from .terms.inertia import InertiaTerm, compute_lumped_mass

                mass = compute_lumped_mass(effect.density, space)
                terms.append(InertiaTerm(mass, effect.damping, space.keys, device))
            case ToolContact() | Retraction():
                from .terms.contact.tool_contact import build_tool_contact

                barriers.append(build_tool_contact(effect, anatomy, space, _compute_min_shear(effects), device))
            case SkullContact():
                from .terms.contact.skull_contact import build_skull

                barriers.append(build_skull(effect, anatomy, space, _compute_min_shear(effects), device))
            case Pulsation() | ToolDisplacement():
                pass  # Elasticity includes the swelling; tool displacement is a constraint, see `_build_imposed`.
            case Resection():
                raise InputError("Resection changes the body: make its solver with `sim.build_fem`.")
            case OwnEffect():
                own.append(effect.term(Body(anatomy, space, surface, device)))
            case _:
                allowed = ", ".join(kind.__name__ for kind in BuiltIn.__args__)
                raise InputError(
                    f"no effect is called {type(effect).__name__}: choose from {allowed}; "
                    "or let your own have cause, remembers and term, as sim.OwnEffect does."
                )
    check_fixed(anatomy.mesh, fixed, normal)
    _check_names((*terms, *barriers), own)
    constraint = Constraint(space.extend_fixed(fixed), space.extend_normals(normal, fixed), device)
    elastic = all(term.constant for term in own)
    return Problem(
        (*terms, *own, *barriers), constraint, device, partial(_build_imposed, space, surface), tuple(barriers), elastic
    )


def _check_compatible(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Return the effects as a tuple; raise `InputError` if they are incompatible."""
    effects = tuple(effects)
    for effect in effects:
        if isinstance(effect, type):
            raise InputError(f"{effect.__name__} is a class, not an instance: write {effect.__name__}(...).")
    kinds = [type(effect) for effect in effects]
    for kind in kinds:
        if kinds.count(kind) > 1:
            raise InputError(f"the effect {kind.__name__} occurs {kinds.count(kind)} times: give it once.")
    if Elasticity not in kinds:
        raise InputError("no effect resists deformation: add Elasticity.")
    skulls = [kind.__name__ for kind in (Bonded, Slide, SkullContact) if kind in kinds]
    if len(skulls) > 1:
        raise InputError(f"{' and '.join(skulls)} are alternative contact models of the skull: choose one.")
    return effects


def _check_names(terms: Iterable[Term], user_terms: Iterable[Term]) -> None:
    """Reject user-defined terms that are not terms or whose names are in use."""
    taken = {term.name for term in terms}
    for term in user_terms:
        if not isinstance(term, Term):
            raise InputError(f"a user-defined effect returned a {type(term).__name__}: must be a sim.Term.")
        if term.name in taken:
            raise InputError(f"two terms are called {term.name!r}: rename the user-defined one.")
        taken.add(term.name)


def _compute_min_shear(effects: Iterable[Effect]) -> float:
    """Return the shear modulus [Pa] of the softest tissue."""
    effect = next(effect for effect in effects if isinstance(effect, Elasticity))
    return min(tissue.lame[0] for tissue in (effect.default, *effect.regions.values()) if tissue is not None)


def check_causes(effects: Iterable[Effect], loads: Loads) -> None:
    """Reject loads whose cause no effect of the scene uses.

    Raises
    ------
    InputError
        `loads` are not `Loads`, or no effect uses a cause; the message gives the cause and the required effect.
    """
    check_loads(loads)
    effects = tuple(effects)
    answered = {CAUSES[type(effect)] for effect in effects if type(effect) in CAUSES}
    answered |= {effect.cause for effect in effects if isinstance(effect, OwnEffect)}
    for cause in loads.causes:
        if type(cause) not in answered:
            needed = next((effect.__name__ for effect, kind in CAUSES.items() if kind is type(cause)), "that it is for")
            raise InputError(f"loads hold {type(cause).__name__}, which no effect uses: add the effect {needed}.")


def _build_imposed(space: Discretisation, skin: ContactSurface, loads: Loads) -> ImposedMotion:
    prescribed, displaced = loads.get(Prescribed), loads.get(Displaced)
    value = None
    if prescribed is not None:
        check_field("Prescribed.displacement", prescribed.displacement, len(space.mesh.nodes))
        value = space.interpolate_field(prescribed.displacement).reshape(len(loads), 3 * space.count).T
    if displaced is None:
        return ImposedMotion(value)
    weight = skin.find_footprints(displaced.point, displaced.footprint).to_matrix(space.count)
    return ImposedMotion(value, weight.toarray().T, displaced.displacement.T)


@dataclass(frozen=True, eq=False)
class LocalProblem:
    """Problem on a subset of the nodes, and a function that sets or clears an external force (3n, b) [N] there."""

    problem: Problem
    set_force: Callable[[wp.array | None], None]


def compile_part(
    effects: Iterable[Effect], space: Discretisation, problem: Problem, tet_mask: np.ndarray, nodes: np.ndarray
) -> Problem:
    """Return the problem with the elasticity of only the tetrahedra in `tet_mask` (T,), on their sorted `nodes`."""
    effect = next(effect for effect in effects if isinstance(effect, Elasticity))
    constraint = Constraint(problem.constraint.fixed[nodes], problem.constraint.normal[nodes], problem.device)
    return Problem(tuple(_build_elasticity(effect, space, problem.device, tet_mask, nodes)), constraint, problem.device)


def add_surrounding_stiffness(part: Problem, rows: np.ndarray, stiffness: np.ndarray) -> LocalProblem:
    """Return the problem `part` with the `stiffness` (m, m) [N/m] of its surroundings added to its `rows` (m,)."""
    from .terms.schur_stiffness import Exterior

    return _build_local_problem(replace(part, terms=(*part.terms, Exterior(rows, stiffness, part.rows, part.device))))


def compile_clamped_part(
    effects: Iterable[Effect], space: Discretisation, problem: Problem, tet_mask: np.ndarray, nodes: np.ndarray
) -> LocalProblem:
    """Return the problem of `compile_part`, with fixed nodes where it borders on tetrahedra that are not selected."""
    effect, device = next(effect for effect in effects if isinstance(effect, Elasticity)), problem.device
    terms = _build_elasticity(effect, space, device, tet_mask, nodes)
    rim = np.isin(nodes, space.table[~tet_mask])[:, None]
    fixed, normal = problem.constraint.fixed[nodes] | rim, np.where(rim, 0.0, problem.constraint.normal[nodes])
    return _build_local_problem(Problem(tuple(terms), Constraint(fixed, normal, device), device))


def _build_local_problem(problem: Problem) -> LocalProblem:
    from .terms.dead_force import DeadForce, NodalForces

    device = problem.device
    load, nodes = DeadForce("load", lambda _: None, device), device.upload(np.arange(problem.rows // 3), wp.int32)
    problem = replace(problem, terms=(*problem.terms, load))
    return LocalProblem(problem, lambda force: load.set_forces(None if force is None else NodalForces(nodes, force)))


def _build_elasticity(
    effect: Elasticity,
    space: Discretisation,
    device: Device,
    tet_mask: np.ndarray | None = None,
    nodes: np.ndarray | None = None,
    pulsation: Pulsation | None = None,
) -> list[AssembledTerm]:
    """Return the elastic terms: one per law and element part, over the elements of all regions with that law.

    `tet_mask` (T,) bool restricts the terms to these tetrahedra, whose `nodes` (n,) are then the unknowns.
    """
    mesh = space.mesh
    labels = [int(label) for label in np.unique(mesh.region)]
    swell = np.isin(mesh.region, labels if pulsation is None or pulsation.regions is None else pulsation.regions)
    absent = set() if pulsation is None else set(pulsation.regions or ()) - set(labels)
    if absent:
        raise InputError(f"Pulsation is given for region {min(absent)}, but the mesh has the regions {labels}.")
    terms: list[AssembledTerm] = []
    for part in list_elastic_parts(effect, space, tet_mask):
        elements = part.elements if nodes is None else part.elements.restrict(nodes)
        swelling = None if pulsation is None else (pulsation, swell[part.elements.owner])
        tissues = list(part.tissues.values())
        terms.append(_build_law_term(tissues, part.tissue_numbers, elements, part.portion, device, swelling))
    return terms


@dataclass(frozen=True, eq=False)
class ElasticPart:
    """Elements of one law and one portion of its stiffness; see `get_lame`.

    Parameters
    ----------
    tissues
        Tissue by region label.
    tissue_numbers
        Index (T,) of the tissue of each element.
    """

    elements: Elements
    portion: str
    tissues: Mapping[int, Tissue]
    tissue_numbers: np.ndarray


def list_elastic_parts(
    effect: Elasticity, space: Discretisation, tet_mask: np.ndarray | None = None
) -> list[ElasticPart]:
    """Return the elements of each elastic term, in the order of the terms; `tet_mask` (T,) selects tetrahedra.

    Raises
    ------
    InputError
        A law is given for a region that the mesh does not have, or a region has no law.
    """
    region = space.mesh.region
    labels = [int(label) for label in np.unique(region)]
    unknown = sorted(set(effect.regions) - set(effect.restrict(labels).regions))
    if unknown:
        raise InputError(f"a law is given for {describe_region(unknown[0])}, but the mesh has the regions {labels}.")
    materials = collect_laws(effect, labels)
    parts: list[ElasticPart] = []
    for law in sorted({(material.law, bool(material.prony)) for material in materials.values()}):
        obeying = {label: one for label, one in materials.items() if (one.law, bool(one.prony)) == law}
        chosen = np.isin(region, list(obeying))
        if tet_mask is not None:
            chosen &= tet_mask
        if chosen.any():
            for part in space.build_elements(chosen):
                numbers = np.searchsorted(list(obeying), region[part.elements.owner])
                parts.append(ElasticPart(part.elements, part.portion, obeying, numbers))
    return parts


def collect_laws(effect: Elasticity, labels: Iterable[int]) -> dict[int, Tissue]:
    """Return the tissue law of each region label in `labels`.

    Raises
    ------
    InputError
        A region without a law.
    """
    laws: dict[int, Tissue] = {}
    for label in labels:
        law = effect.get_law(label)
        if law is None:
            raise InputError(f"region {label} has no tissue law: name one for it, or a default.")
        laws[label] = law
    return laws


def _build_law_term(
    tissues: Sequence[Tissue],
    tissue_numbers: np.ndarray,
    elements: Elements,
    portion: str,
    device: Device,
    swelling: tuple[Pulsation, np.ndarray] | None,
) -> AssembledTerm:
    """Return the term of elements with `tissue_numbers` (T,). All tissues have the same law; all or none relax.

    `swelling` is the effect and a mask (T,) of the elements that swell, or None.
    """
    from .terms.elasticity import ElasticTerm

    law = build_functions(tissues)
    if portion == "springs":
        from .terms.laws.springs import LAW, compute_spring_coefficients

        if tissues[0].prony or swelling is not None:
            raise InputError("springs compute neither relaxation nor pulsation: use finite elements.")
        lame = np.array([tissue.lame for tissue in tissues])[tissue_numbers]
        return ElasticTerm(
            f"springs for {law.name}", LAW, elements, compute_spring_coefficients(lame, elements.gradient), lame, device
        )
    lame = np.array([get_lame(tissue, portion) for tissue in tissues])[tissue_numbers]
    coefficients = collect_coefficients(tissues, portion)[tissue_numbers]
    name = f"elasticity {law.name}" if portion == "whole" else f"elasticity {law.name} of {portion}"
    sources = []
    if tissues[0].prony and portion != "volume":  # the volumetric part does not relax
        from .terms.viscoelastic import Prony

        name, points = f"visco{name}", elements.weight.shape[1]
        pairs = [tissues[tissue].prony for tissue in tissue_numbers]
        sources.append(Prony(name, law, coefficients, pairs, points, device))
    if swelling is not None and swelling[1].any():
        from .terms.swelling import Swelling

        sources.append(Swelling(swelling[0].compute_swelling, swelling[1], device))
    return ElasticTerm(name, law, elements, coefficients, lame, device, sources)
