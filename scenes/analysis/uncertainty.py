"""Ensemble of a scene: FEM solutions for parameters sampled from priors, and the resulting position error."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ar.rendering.layer import compute_vertex_normals
from sim.accuracy import Accuracy
from sim.anatomy import TUMOUR_LABEL
from sim.deformation import Deformation
from sim.effects import SKULLS, Effect, Elasticity, Gravity, ToolContact
from sim.errors import InputError
from sim.material import LAWS, IsotropicTissue, Ogden
from sim.skulls import Bonded, SkullContact, Slide

from ..play.deformers import PatientSetup
from ..play.stage import Stage
from ..script.priors import (
    COMBINED,
    EXPONENT,
    MESH,
    MESH_PRIOR,
    POISSON,
    RATIO,
    REGISTRATION,
    REGISTRATION_PRIOR,
    SEGMENTATION,
    SEGMENTATION_PRIOR,
    SINKING_MESH_PRIOR,
    SKULL,
    SLIDING_MESH_PRIOR,
    STIFFNESS,
    TOOL,
    ParameterPrior,
    PatientSample,
    choose_name,
    has_exponent,
    sample_rigid_errors,
)  # fmt: skip
from ..script.scene import Scene
from ..script.tool_paths import shift_path
from ..script.uncertainty import LEVEL, Uncertainty, compute_scene_mark

ACCURACY = Accuracy(3e-3, outer=60, limit_strain=False)  # Samples with inverted tetrahedra are counted, not left out.


@dataclass(frozen=True)
class EnsembleSettings:
    """Settings of an ensemble and of its rigid errors."""

    solved_times: int = 5  # Number of times of a scene that are solved.
    min_solved_share: float = 0.8  # Minimum share of the samples with an equilibrium.
    load_steps: int = 4  # Number of load steps for a time that is not reached in one step.
    shift_count: int = 200  # Number of sampled errors of registration and segmentation for each body.


ENSEMBLE = EnsembleSettings()
SKULL_EFFECTS = Bonded | Slide | SkullContact  # Effects of the skull on the brain.


@dataclass(frozen=True, eq=False)
class SolvedMotions:
    """Motions (n, 3) [m] of the tumour's surface at each solved time, and maximum number of inverted tetrahedra."""

    motions: tuple[np.ndarray, ...]
    inverted: int = 0


Answer = SolvedMotions | None
"""Motions of a sample; None if any solved time has no equilibrium."""
SoundDraws = list[tuple[PatientSample, tuple[np.ndarray, ...]]]
"""Samples with an equilibrium at each solved time, and their motions [m]."""


@dataclass(frozen=True, eq=False)
class SurfaceMotions:
    """Motions and normals of the tumour's surface at each solved time.

    Parameters
    ----------
    fields
        Displacements (n, 3) [m] at each time. The vertices differ between times if tissue is resected.
    normals
        Outward normals (n, 3) of the undeformed surface at each time.
    """

    times: tuple[float, ...]
    fields: tuple[np.ndarray, ...]
    normals: tuple[np.ndarray, ...]


def apply_sample(scene: Scene, sample: PatientSample) -> Scene:
    """Return the scene with the sample's tissue, tumour stiffness, skull model and tool position.

    Raises
    ------
    InputError
        A tissue of the scene is not described by Young's modulus and Poisson's ratio.
    """
    tissue, given = get_tissue(scene), scene.elasticity.regions
    regions = {label: sample.scale_tissue(one) for label, one in given.items() if isinstance(one, IsotropicTissue)}
    tumour = sample.scale_tissue(get_tumour_tissue(scene), sample.ratio)
    elasticity = Elasticity(sample.scale_tissue(tissue), {**regions, TUMOUR_LABEL: tumour})
    skull = SKULLS[choose_name(sample.skull, list_skulls(scene))]

    def replace_effect(effect: Effect) -> Effect:
        return elasticity if isinstance(effect, Elasticity) else skull if isinstance(effect, SKULL_EFFECTS) else effect

    return replace(scene, effects=tuple(map(replace_effect, scene.effects)), path=shift_path(scene.path, sample.tip))


def list_skulls(scene: Scene) -> tuple[str, ...]:
    """List the possible skull models of a scene; "bonded" is excluded if the brain can separate from the skull."""
    lets_go = any(isinstance(effect, SkullContact) for effect in scene.effects)
    return tuple(name for name in SKULLS if not (lets_go and name == "bonded"))


def get_skull_model(scene: Scene) -> str | None:
    """Return the name of a scene's skull model; None if the scene has no skull effect."""
    own = next((type(effect) for effect in scene.effects if isinstance(effect, SKULL_EFFECTS)), None)
    return next((name for name, skull in SKULLS.items() if type(skull) is own), None)


def find_mesh_prior(scene: Scene, skull: str | None) -> ParameterPrior:
    """Return the prior of a scene's mesh error for a skull model (None: no skull effect)."""
    if skull in (None, "bonded"):
        return MESH_PRIOR
    return SINKING_MESH_PRIOR if any(isinstance(effect, Gravity) for effect in scene.effects) else SLIDING_MESH_PRIOR


def sample_mesh_errors(scene: Scene, samples: Sequence[PatientSample]) -> np.ndarray:
    """Return the mesh error (draws,) of each sample, relative to the sample's motion."""
    return estimate_mesh_deviations(scene, samples) * np.array([draw.mesh for draw in samples])


def estimate_mesh_deviations(scene: Scene, samples: Sequence[PatientSample]) -> np.ndarray:
    """Return the standard deviation (draws,) of each sample's mesh error, relative to the sample's motion."""
    if get_skull_model(scene) is None:
        return np.full(len(samples), find_mesh_prior(scene, None).range[1])
    skulls = list_skulls(scene)
    return np.array([find_mesh_prior(scene, choose_name(draw.skull, skulls)).range[1] for draw in samples])


def get_tissue(scene: Scene) -> IsotropicTissue:
    """Return the brain's default tissue in a scene; regions may have other tissues.

    Raises
    ------
    InputError
        The tissue of the scene or of a region has no Young's modulus and Poisson's ratio.
    """
    elasticity = scene.elasticity
    strange = [one for one in elasticity.regions.values() if not isinstance(one, IsotropicTissue)]
    if not isinstance(elasticity.default, IsotropicTissue) or strange:
        has = strange[0] if strange else elasticity.default or "none that all regions share"
        raise InputError(
            f"priors draw Young's modulus and Poisson's ratio, and the scene {scene.name} has another tissue: {has}. "
            f"Give it one of the laws {', '.join((*LAWS, Ogden.law))}, by --material or in its file."
        )
    return elasticity.default


def get_tumour_tissue(scene: Scene) -> IsotropicTissue:
    """Return the tumour's tissue in a scene, or the brain's tissue if the tumour has no tissue of its own.

    Raises
    ------
    InputError
        See `get_tissue`.
    """
    brain, tumour = get_tissue(scene), scene.elasticity.regions.get(TUMOUR_LABEL)
    return tumour if isinstance(tumour, IsotropicTissue) else brain


def list_solved_times(scene: Scene) -> tuple[float, ...]:
    """Return the times [s] of a scene at which ensembles are solved."""
    return tuple(np.linspace(0.0, scene.duration, ENSEMBLE.solved_times).tolist())


def solve_nominal(patient: PatientSetup, scene: Scene) -> SurfaceMotions:
    """Solve the scene with its own parameters, at the times of `list_solved_times`.

    Raises
    ------
    InputError
        The anatomy has no tumour, or a time has no equilibrium.
    """
    if not len(patient.anatomy.tumour_nodes):
        raise InputError("the anatomy has no tumour to be uncertain of: make one with `sulcus anatomy`.")
    result, normals = solve_scene(patient, scene), []
    if result is None:
        raise InputError(f"of the scene {scene.name} itself no equilibrium was found.")
    for time in list_solved_times(scene):
        loads = scene.build_loads(patient.site, scene.path(time), time)
        tumour = Stage(scene, patient.site).select_stage(loads).build_tumour(patient.anatomy.mesh.nodes)
        normals.append(compute_vertex_normals(tumour.vertices, tumour.triangles))
    return SurfaceMotions(list_solved_times(scene), result.motions, tuple(normals))


def solve_scene(patient: PatientSetup, scene: Scene) -> Answer:
    """Compute the tumour's motions at each time of `list_solved_times`; None if any time has no equilibrium.

    If the step from the previous time does not converge, intermediate times are solved, not load steps from rest.
    """
    touches = any(isinstance(effect, ToolContact | SkullContact) for effect in scene.effects)
    accuracy = ACCURACY if touches else replace(ACCURACY, steps=0)
    fem, stage = patient.build_fem(scene, accuracy, batch=1), Stage(scene, patient.site)
    last, found, before, inverted = None, [], 0.0, 0

    def solve_times(times: Sequence[float], start: Deformation | None) -> Deformation | None:
        for time in times:
            start = fem.deform(scene.build_loads(patient.site, scene.path(time), time), start=start)
            if not start.outcome[0].good:
                return None
        return start

    for time in list_solved_times(scene):
        result = solve_times([time], last)
        if result is None and time > before:
            result = solve_times(np.linspace(before, time, 1 + ENSEMBLE.load_steps)[1:].tolist(), last)
        if result is None:
            return None
        last, before, inverted = result, time, max(inverted, int(result.inverted[0]))
        loads = scene.build_loads(patient.site, scene.path(time), time)
        found.append(last.restrict(stage.select_stage(loads).tumour_vertices).displacement[0])
    return SolvedMotions(tuple(found), inverted)


def solve_ensemble(patient: PatientSetup, scene: Scene, samples: Sequence[PatientSample]) -> Iterator[Answer]:
    """Yield the motions of each sample; None for a sample without equilibrium."""
    for draw in samples:
        yield solve_scene(patient, apply_sample(scene, draw))


def select_solved_samples(samples: Sequence[PatientSample], solutions: Iterable[Answer]) -> SoundDraws:
    """Return the samples that have an equilibrium at each solved time, with their motions."""
    return [(draw, result.motions) for draw, result in zip(samples, solutions, strict=True) if result is not None]


def filter_solved_samples(scene: Scene, samples: Sequence[PatientSample], solutions: Iterable[Answer]) -> SoundDraws:
    """Return the samples of `select_solved_samples`, after a check that the share of solved samples is large enough.

    Raises
    ------
    InputError
        Too few samples have an equilibrium.
    """
    sound = select_solved_samples(samples, solutions)
    if len(sound) < ENSEMBLE.min_solved_share * len(samples):
        found = f"of {len(samples)} draws of the scene {scene.name} {len(sound)}"
        raise InputError(f"{found} have an equilibrium: too few.")
    return sound


def estimate_uncertainty(
    patient: PatientSetup,
    scene: Scene,
    nominal: SurfaceMotions,
    samples: Sequence[PatientSample],
    solutions: Iterable[Answer],
    seed: int = 0,
) -> Uncertainty:
    """Estimate the error of the shown tumour position from the motions of an ensemble.

    Raises
    ------
    InputError
        Too few samples have an equilibrium.
    """
    solutions = tuple(solutions)
    sound = filter_solved_samples(scene, samples, solutions)
    folded = sum(result is not None and result.inverted > 0 for result in solutions)
    kept, shifts = [draw for draw, _ in sound], sample_rigid_errors(ENSEMBLE.shift_count, seed)
    meshes = sample_mesh_errors(scene, kept)
    rows = []
    for moment, (field, normals) in enumerate(zip(nominal.fields, nominal.normals, strict=True)):
        motion = np.stack([result[moment] for _, result in sound])
        off, (shift, wide) = compute_motion_errors(motion, field, meshes), shifts
        worst, middle = compute_worst_distances(off, normals, shift, wide)
        registered, _ = compute_worst_distances(off, normals, 0.0 * shift, wide)
        errors = worst, middle, registered, np.linalg.norm(off.mean(axis=1), axis=1)
        bounds = [float(np.quantile(one, LEVEL)) for one in errors]
        moved = float(np.linalg.norm(field, axis=1).mean())
        rows.append((*bounds, moved, split_contributions(motion, field, kept, scene)))
    *lists, by_name = zip(*rows, strict=True)
    return Uncertainty(
        scene=scene.name,
        mark=compute_scene_mark(scene, patient.site, patient.choose_element(scene)),
        draws=len(samples),
        failed=len(samples) - len(sound),
        times=nominal.times,
        **dict(zip(("worst", "middle", "registered", "motion", "moved"), lists, strict=True)),
        parts={name: tuple(row[name] for row in by_name) for name in by_name[0]},
        folded=folded,
        numbers=sum(column.shape[1] for column in collect_contributor_values(kept, scene).values()),
    )


def compute_motion_errors(motion: np.ndarray, field: np.ndarray, mesh_errors: np.ndarray) -> np.ndarray:
    """Return errors (draws, n, 3) [m]: motions of samples with mesh errors (draws,), minus the scene's motion."""
    return (1.0 + mesh_errors)[:, None, None] * motion - field


def compute_worst_distances(
    errors: np.ndarray, normals: np.ndarray, shifts: np.ndarray, offsets: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return maximum surface errors and centroid errors (draws, shifts) [m], for each sample with each rigid error.

    `errors` (draws, n, 3) [m]: model errors; `normals` (n, 3); `shifts` (shifts, 3) [m]: registration errors;
    `offsets` (shifts,) [m]: segmentation errors.
    """
    aside = shifts[:, None] + offsets[:, None, None] * normals
    worst = np.stack([np.linalg.norm(one + aside, axis=2).max(axis=1) for one in errors])
    middle = np.stack([np.linalg.norm((one + aside).mean(axis=1), axis=1) for one in errors])
    return worst, middle


def split_contributions(
    motion: np.ndarray, field: np.ndarray, samples: Sequence[PatientSample], scene: Scene
) -> dict[str, float]:
    """Return by contributor the root mean square over samples of the maximum surface error [m] of this contributor.

    A linear fit to the samples' motions (draws, n, 3) separates contributors; the residual is their interaction.
    """
    off, columns = motion - field, collect_contributor_values(samples, scene)
    design = np.concatenate(list(columns.values()), axis=1)
    slope = np.linalg.lstsq(design, off.reshape(len(off), -1), rcond=None)[0]
    found, first = {}, 0
    for name, column in columns.items():
        last = first + column.shape[1]
        found[name] = compute_rms_of_largest((column @ slope[first:last]).reshape(off.shape))
        first = last
    found[COMBINED] = compute_rms_of_largest(off - (design @ slope).reshape(off.shape))
    found[MESH] = compute_rms_of_largest(estimate_mesh_deviations(scene, samples)[:, None, None] * motion)
    return found | {REGISTRATION: 3.0**0.5 * REGISTRATION_PRIOR.range[1], SEGMENTATION: SEGMENTATION_PRIOR.range[1]}


def collect_contributor_values(samples: Sequence[PatientSample], scene: Scene) -> dict[str, np.ndarray]:
    """Return, by contributor, parameters (draws, columns) of the samples minus those of the scene."""
    tissue = get_tissue(scene)
    rows = [[np.log(one.stiffness), one.poisson - tissue.poisson, np.log(one.ratio), *one.tip] for one in samples]
    table = np.array(rows)
    found = {STIFFNESS.name: table[:, :1], POISSON.name: table[:, 1:2], RATIO.name: table[:, 2:3]}
    if has_exponent(tissue):
        own = tissue.terms[0][1]
        found[EXPONENT.name] = np.log([[(one.exponent or own) / own] for one in samples])
    skull = get_skull_model(scene)
    others = [name for name in list_skulls(scene) if name != skull]
    names = [choose_name(draw.skull, list_skulls(scene)) for draw in samples]
    if skull is not None:
        found[SKULL] = np.array([[name == other for other in others] for name in names], float)
    return found if scene.tool is None else found | {TOOL: table[:, 3:]}


def compute_rms_of_largest(field: np.ndarray) -> float:
    """Compute the root mean square over samples of the maximum length of the vectors (draws, n, 3)."""
    return float(np.sqrt((field**2).sum(axis=2).max(axis=1).mean()))


def measure_coverage(
    scene: Scene,
    nominal: SurfaceMotions,
    uncertainty: Uncertainty,
    samples: Sequence[PatientSample],
    solutions: Iterable[Answer],
    seed: int,
) -> Uncertainty:
    """Return the uncertainty with its coverage on synthetic patients: new samples with new registration errors.

    Raises
    ------
    InputError
        Fewer than two synthetic patients have an equilibrium.
    """
    sound = select_solved_samples(samples, solutions)
    if len(sound) < 2:
        raise InputError(
            f"{len(sound)} of {len(samples)} synthetic patients of the scene {scene.name} have an equilibrium: too few."
        )
    meshes, inside = sample_mesh_errors(scene, [draw for draw, _ in sound]), []
    shape = len(sound), ENSEMBLE.shift_count  # different errors for each patient
    shift, wide = sample_rigid_errors(shape[0] * shape[1], seed)
    each = list(zip(shift.reshape(*shape, 3), wide.reshape(shape), strict=True))
    for moment in range(1, len(nominal.times)):
        motion = np.stack([result[moment] for _, result in sound])
        off = compute_motion_errors(motion, nominal.fields[moment], meshes)
        pairs, normals = zip(off, each, strict=True), nominal.normals[moment]
        worst = [compute_worst_distances(one[None], normals, *errors)[0][0] for one, errors in pairs]
        inside.append(np.array(worst) <= uncertainty.worst[moment])
    shares = np.mean(inside, axis=(0, 2))  # errors of one patient depend on each other
    deviation = float(shares.std(ddof=1) / np.sqrt(len(shares)))
    return replace(uncertainty, patients=len(shares), covered=float(shares.mean()), deviation=deviation)
