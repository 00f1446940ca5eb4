"""Sensitivity of the tumour's motion to tissue, skull, tool and element type, with one change at a time."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim.accuracy import NO_STRAIN_LIMIT, Accuracy
from sim.anatomy import TUMOUR_LABEL, Anatomy
from sim.deformation import Deformation, build_start
from sim.discretisation.footprint import compute_footprint_weights
from sim.effects import SKULLS, Elasticity, ToolDisplacement, build_push_effects
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import MAGNITUDE, Displaced, Loads, Pushed, stack
from sim.material import BRAIN, IsotropicTissue, Ogden, build_law
from surrogate.data.cortex_patch import Patch, open_patch
from surrogate.data.tool_loads import find_perpendiculars

LAW_VARIANTS = "neo-hookean", Ogden.law
"""Laws with the same E and nu at small strain; Ogden's exponent is that of measured brain."""


@dataclass(frozen=True)
class BodyVariant:
    """Variant of the FEM model: tissue, stiffness of the tumour relative to the brain, skull model, element type.

    `skull` is a key of `sim.effects.SKULLS`. The default element type is "smoothed", because locking of linear
    tetrahedra near nu = 0.5 would look like an influence of nu.
    """

    tissue: IsotropicTissue = BRAIN
    tumour: float = 1.0
    skull: str = "bonded"
    element: str = "smoothed"


@dataclass(frozen=True)
class LoadPerturbation:
    """Perturbation of a load: force or motion changed by a share, turned by `turn` [rad], or moved by `shift` [m].

    Directions of a perturbation: `share` is added and subtracted, `turn` is about two axes, `shift` to four sides.
    """

    share: float = 0.0
    turn: float = 0.0
    shift: float = 0.0


@dataclass(frozen=True)
class Variant:
    """Variant with one changed factor: name of the factor, default and changed value, resulting model and load."""

    factor: str
    default: str
    changed: str
    body: BodyVariant
    perturbation: LoadPerturbation = LoadPerturbation()


def list_variants(anatomy: Anatomy, body: BodyVariant, elements: Sequence[str] = ()) -> list[Variant]:
    """List the variants of tool, tissue and skull, and of the element types `elements`, that differ from `body`."""
    tissue = body.tissue
    text, poisson, tumour = f"{tissue.young:g} Pa", f"{tissue.poisson:g}", f"{body.tumour:g} x brain"
    changed = [
        Variant("force or motion", "as drawn", "+-5 %", body, LoadPerturbation(share=0.05)),
        Variant("its direction", "as drawn", "+-2 deg", body, LoadPerturbation(turn=np.radians(2.0))),
        Variant("its position", "as drawn", "+-1 mm", body, LoadPerturbation(shift=1e-3)),
        *(
            Variant(
                "E", text, f"{step:+.0%}", replace(body, tissue=tissue.replace_constants((1.0 + step) * tissue.young))
            )
            for step in (-0.2, 0.2)
        ),
        *(
            Variant("nu", poisson, f"{nu:g}", replace(body, tissue=tissue.replace_constants(poisson=nu)))
            for nu in (0.45, 0.49, 0.495)
        ),
        *(
            Variant("law", tissue.law, law, replace(body, tissue=build_law(law, tissue.young, tissue.poisson)))
            for law in LAW_VARIANTS
            if law != tissue.law
        ),
        *(
            Variant("tumour's stiffness", tumour, f"{ratio:g} x", replace(body, tumour=ratio))
            for ratio in (0.5, 1.0, 2.0, 3.0)
        ),
    ]
    if anatomy.slide_normal.any():
        changed += [Variant("skull", body.skull, skull, replace(body, skull=skull)) for skull in SKULLS]
    changed += [Variant("element", body.element, element, replace(body, element=element)) for element in elements]
    return [variant for variant in changed if variant.body != body or variant.perturbation != LoadPerturbation()]


def perturb_loads(loads: Loads, perturbation: LoadPerturbation, patch: Patch) -> Loads:
    """Return the loads of a tool with a perturbation, as one block of loads for each direction of the perturbation.

    Points are shifted in the tangent plane of the open cortex.
    """
    (cause,) = loads.causes
    if not isinstance(cause, Pushed | Displaced):
        raise InputError(f"loads of the kind {type(cause).__name__} have no aim: give `Pushed` or `Displaced`.")
    name = MAGNITUDE[type(cause)]
    vector = getattr(cause, name)
    vectors, points = [vector], [cause.point]
    if perturbation.share:
        vectors = [(1.0 + share) * vector for share in (perturbation.share, -perturbation.share)]
    if perturbation.turn:
        length = np.linalg.norm(vector, axis=1, keepdims=True)
        turned = [np.sin(perturbation.turn) * length * way for way in find_perpendiculars(vector / length)]
        vectors = [np.cos(perturbation.turn) * vector + aside for aside in turned]
    if perturbation.shift:
        first, second = find_perpendiculars(patch.find_normals(cause.point))
        points = [cause.point + perturbation.shift * way for way in (first, -first, second, -second)]
    return stack(
        [Loads((replace(cause, **{name: one, "point": point}),), loads.time) for one in vectors for point in points]
    )


@dataclass(frozen=True)
class MotionChange:
    """Difference of the tumour's displacement from the default model, over `solves` converged loads; `failed` failed.

    Parameters
    ----------
    mean_mm, p95_mm, largest_mm
        Mean, 95th percentile and maximum of the difference over all loads x vertices [mm].
    worst95_mm
        95th percentile over loads of the maximum vertex difference [mm], comparable with a surrogate's bound.
    percent
        Mean difference of a load relative to the load's mean motion in the default model [%], averaged over loads.
    motion
        Ratio of the mean motion to the mean motion in the default model.
    """

    solves: int
    failed: int
    mean_mm: float
    p95_mm: float
    worst95_mm: float
    largest_mm: float
    percent: float
    motion: float


@dataclass(frozen=True)
class SensitivityRow:
    """Variant with its changes under prescribed tool forces, and under prescribed tool motions."""

    variant: Variant
    force: MotionChange
    motion: MotionChange


@dataclass(frozen=True, eq=False)
class SensitivityStudy:
    """Study of the same `Pushed` loads on variants of the FEM model `body`."""

    anatomy: Anatomy
    loads: Loads
    body: BodyVariant
    accuracy: Accuracy = NO_STRAIN_LIMIT
    device: str = "auto"

    def build_fem(self, body: BodyVariant) -> Fem:
        """Build the FEM solver of a variant, for prescribed tool forces and motions."""
        tissue = body.tissue
        _, *others = build_push_effects(self.anatomy, tissue, body.skull)
        elasticity = Elasticity(tissue, {TUMOUR_LABEL: tissue.replace_constants(body.tumour * tissue.young)})
        effects = (elasticity, *others, ToolDisplacement())
        return Fem(self.anatomy, effects, self.accuracy, self.device, element=body.element)


def measure_variants(study: SensitivityStudy, variants: Sequence[Variant]) -> Iterator[SensitivityRow]:
    """Yield a row for the default model, whose change is its whole motion, then the change of each variant.

    Prescribed motions are the mean motions of the footprints in the default model under the forces. Every solve starts
    from the default model's solution, so that solutions stay on the same equilibrium if a load has several.

    Raises
    ------
    InputError
        The anatomy has no tumour or open cortex, loads are not `Pushed`, or `Fem` rejects its input.
    """
    nodes, patch = study.anatomy.tumour_nodes, open_patch(study.anatomy)
    if not len(nodes):
        raise InputError("the anatomy has no tumour whose motion could change: make one with `sulcus anatomy`.")
    body, fem = study.body, study.build_fem(study.body)
    pushed = fem.deform(study.loads)
    matched = match_motion(study.anatomy, study.loads, pushed)
    defaults = ((study.loads, pushed), (matched, fem.deform(matched, build_start(pushed.displacement))))
    rest = np.zeros((len(study.loads), len(nodes), 3))
    whole = [compute_change(default.restrict(nodes), default.restrict(nodes), rest) for _, default in defaults]
    yield SensitivityRow(Variant("motion itself", "", "", body), *whole)
    for variant in variants:
        if variant.body != body:
            body, fem = variant.body, study.build_fem(variant.body)
        found = []
        for loads, default in defaults:
            asked = perturb_loads(loads, variant.perturbation, patch)
            start = np.tile(default.displacement, (len(asked) // len(loads), 1, 1))
            of_default = default.restrict(nodes)
            found.append(
                compute_change(fem.deform(asked, build_start(start), nodes), of_default, of_default.displacement)
            )
        yield SensitivityRow(variant, *found)


def compute_change(result: Deformation, default: Deformation, reference: np.ndarray) -> MotionChange:
    """Compute the change of `result`, k blocks of the loads of `default`, from displacements `reference` (B, n, 3) [m].

    Only loads that converged in `result` and in `default` count.
    """
    ways = len(result) // len(default)
    sound, good = (np.array([outcome.good for outcome in one.outcome]) for one in (default, result))
    good = good & np.tile(sound, ways)
    if not good.any():
        return MotionChange(0, len(good), *[np.nan] * 6)
    now, then, reference = (
        1e3 * field[good]
        for field in (result.displacement, *(np.tile(one, (ways, 1, 1)) for one in (default.displacement, reference)))
    )
    distance = np.linalg.norm(now - reference, axis=2)
    motion, before = (np.linalg.norm(field, axis=2).mean(axis=1) for field in (now, then))
    return MotionChange(
        int(good.sum()),
        int(len(good) - good.sum()),
        float(distance.mean()),
        float(np.percentile(distance, 95.0)),
        float(np.percentile(distance.max(axis=1), 95.0)),
        float(distance.max()),
        100.0 * float((distance.mean(axis=1) / before).mean()),
        float(motion.mean() / before.mean()),
    )


def match_motion(anatomy: Anatomy, loads: Loads, result: Deformation) -> Loads:
    """Build loads that prescribe the mean footprint motions that the forces of `loads` cause in `result`.

    Mean motions are computed from corner vertices, which is an approximation for quadratic elements.
    """
    cause = loads.get_only(Pushed)
    if cause is None:
        raise InputError("known motions are derived from forces: give `Pushed` loads alone.")
    mesh = anatomy.mesh
    weight = compute_footprint_weights(mesh.nodes, mesh.surface, cause.point, cause.footprint).toarray()
    motion = np.einsum("bv,bvi->bi", weight, result.displacement)
    return Loads((Displaced(cause.point, motion, cause.footprint),), loads.time)
