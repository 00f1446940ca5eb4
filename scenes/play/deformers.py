"""Anatomy with its scan and its files, and the deformers that are available for this anatomy, by name."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from sim.accuracy import LIVE, Accuracy
from sim.anatomy import Anatomy, describe_region
from sim.bodies.intensity import Intensity, read_intensity, to_intensity_path
from sim.bodies.meshfile import read_anatomy
from sim.deformation import Deformation, Deformer, build_start
from sim.discretisation.space import recommend_element
from sim.effects import Bonded, Elasticity, Held, ToolForce
from sim.errors import InputError
from sim.families.registry import FAMILIES, build_family
from sim.fem import Fem, describe_solver
from sim.loads import Loads
from sim.resected_fem import ResectedFem, build_fem
from sim.runtime.device import find_device
from surrogate.data.solution_rows import find_first_tissue
from surrogate.locating.locator import Locator
from surrogate.locating.locator_store import load_locator, to_locator_path
from surrogate.locating.regions import find_differing_regions
from surrogate.model.applicability import find_rejection
from surrogate.model.guarded import Guarded, get_reported_errors
from surrogate.model.held_out import MAX_VERTEX_ERROR
from surrogate.model.learned import Learned
from surrogate.model.store import load

from ..script.craniotomy_frame import CraniotomyFrame, build_craniotomy_frame
from ..script.observation_models import PointObservation, StereoObservation
from ..script.scene import SCENES, Scene, check_scene_exists, find_scene
from ..script.shipped_files import get_template_path
from ..script.uncertainty import (
    MotionError,
    Uncertainty,
    compute_scene_mark,
    fit_motion_error,
    read_uncertainties,
    to_uncertainty_path,
)
from .effect_record import SUFFIX, EffectRecord, read_effect_records
from .family_record import FamilyFigures, read_family_figures
from .observer import PointObserver
from .player import Player
from .stage import Stage
from .stereo_observer import StereoObserver

GUARDED = "guarded"
"""Name of the deformer that uses the best trained model, with FEM as fallback."""
# Text: FEM's result is the reference of an estimate.
TRUTH_TEXT = "what an estimate is held against is the truth, as finite elements have it"


@dataclass(frozen=True, eq=False)
class PatientSetup:
    """Anatomy, T1 scan (None if not available), models by name, uncertainties and costs of effects by scene.

    `locator_file` contains the locator of the tumour, for scenes with an observation model. A guarded model uses FEM
    above a predicted error of `limit` [m]; None: limit derived from held-out cortex. `families` caches built families.
    """

    anatomy: Anatomy
    intensity: Intensity | None
    models: Mapping[str, Learned]
    device: str = "auto"
    locator_file: Path | None = None
    uncertainties: Mapping[str, Uncertainty] = field(default_factory=dict)
    limit: float | None = None
    effect_records: Mapping[str, EffectRecord] = field(default_factory=dict)
    family_figures: Mapping[str, FamilyFigures] = field(default_factory=dict)
    families: dict[str, Deformer] = field(default_factory=dict)

    @cached_property
    def site(self) -> CraniotomyFrame:
        """Coordinate system of the craniotomy of this anatomy."""
        return build_craniotomy_frame(self.anatomy)

    @cached_property
    def locator(self) -> Locator:
        """Locator of the tumour.

        Raises
        ------
        InputError
            The file does not exist, or belongs to another anatomy.
        """
        path = self.locator_file
        if path is None or not path.is_file():
            beside = "" if path is None else f" at {path}"
            raise InputError(
                f"the tumour cannot be located: this anatomy has no locator{beside}. `sulcus locator ANATOMY.vtu` "
                "makes it, in up to 13 minutes on two cores."
            )
        return load_locator(path, self.anatomy)

    @cached_property
    def learned_tissue(self) -> Elasticity | None:
        """Tissue of brain and regions that the models were trained on; None if no model reports a tissue.

        Raises
        ------
        InputError
            A model file contains an invalid tissue.
        """
        return find_first_tissue(model.training for model in self.models.values())

    def is_without_locator(self, scene: Scene) -> bool:
        """Return True if a scene has an observation model and this anatomy has no locator file."""
        return scene.observation_model is not None and (self.locator_file is None or not self.locator_file.is_file())

    def build_stage(self, scene: Scene) -> Stage:
        """Build the rendered parts of a scene on this anatomy; rendering uses the device of this setup.

        Raises
        ------
        InputError
            The scene has an observation model, and the locator is missing or has another stiffness of a region.
        """
        device = find_device(self.device, LIVE.precision).name
        if scene.observation_model is not None and (
            unlike := find_differing_regions(scene.elasticity, self.locator.regions)
        ):
            raise InputError(
                f"{scene.name}: the locator at {self.locator_file} has another stiffness of "
                f"{' and '.join(map(describe_region, unlike))} than the scene. Compute it again: `sulcus locator "
                "ANATOMY.vtu`, with the same --region."
            )
        stage = Stage(scene, self.site, self.intensity, device=device)
        match scene.observation_model:
            case None:
                return stage
            case PointObservation():
                return replace(stage, observer=PointObserver(self.site, self.locator, scene.observation_model))
            case StereoObservation():
                return replace(stage, observer=StereoObserver(stage, self.locator, scene.observation_model))

    def list_rejections(self, scene: Scene) -> dict[str, str | None]:
        """Return by model name the reason why a trained model does not support a scene; None for a model that does.

        A model supports only the effects, the tissue and the element type of its training. No model supports a scene
        with an observation model, because FEM must compute the reference for its estimates.
        """
        if scene.observation_model is not None:
            return dict.fromkeys(self.models, TRUTH_TEXT)
        effects, element = scene.get_effects_on(self.anatomy), self.choose_element(scene)
        return {name: find_rejection(model, effects, element) for name, model in self.models.items()}

    def select_models(self, scene: Scene) -> dict[str, Learned]:
        """Select the trained models that support a scene, by name."""
        return {name: self.models[name] for name, reason in self.list_rejections(scene).items() if reason is None}

    def list_deformers(self, scene: Scene) -> tuple[str, ...]:
        """List names of the deformers for a scene: supporting models, "guarded" if FEM can be a fallback, and "fem"."""
        knowing = tuple(self.select_models(scene))
        return (*knowing, *([GUARDED] if self._can_guard(scene) else []), "fem")

    def select_best(self, scene: Scene) -> str:
        """Return the name of the trained model with the smallest error bound; "fem" if no model supports the scene."""
        knowing = self.select_models(scene)
        return min(knowing, key=lambda name: knowing[name].bound, default="fem")

    def select_default_scene(self) -> str:
        """Return the name of the first built-in scene that a trained model supports; "press" if there is none."""
        return next((name for name in SCENES if self.select_models(find_scene(name))), "press")

    def limit_of(self, scene: Scene) -> float:
        """Return the predicted error [m] above which FEM replaces the best model of a scene."""
        stated = self.models[self.select_best(scene)].held_out
        if self.limit is not None:
            return self.limit
        return MAX_VERTEX_ERROR if stated is None else stated.limit

    def select_default(self, scene: Scene) -> str:
        """Return the name of a scene's default deformer: the scene's choice, else the best model, else "fem".

        The best model is guarded if its error bound is weak and its tissue does not relax: see `_can_guard`.
        """
        name = self.select_best(scene)
        if scene.deformer in (*self.select_models(scene), *FAMILIES):
            return scene.deformer
        return GUARDED if self._can_guard(scene) and get_reported_errors(self.models[name]).is_weak else name

    def _can_guard(self, scene: Scene) -> bool:
        """Return True if FEM can be the fallback of the best model.

        With relaxing tissue FEM cannot: an FEM frame would need the FEM solutions of all previous frames.
        """
        name = self.select_best(scene)
        return name in self.models and not self.models[name].series

    def describe_deformer(self, name: str, scene: Scene) -> str:
        """Describe the deformer `name` in a scene: its FEM solver, or the training of its model."""
        solver = describe_solver(self.choose_element(scene), scene.effects)
        if name == GUARDED:
            model, limit = self.models[self.select_best(scene)], 1e3 * self.limit_of(scene)
            return f"{model.source}; where its error may exceed {limit:g} mm, {solver}"
        return solver if name == "fem" else FAMILIES[name] if name in FAMILIES else self.models[name].source

    def build_fem(self, scene: Scene, accuracy: Accuracy, batch: int = 64, live: bool = False) -> Fem | ResectedFem:
        """Build the FEM solver of a scene's effects, tissue and element type; see `Fem` for `live`."""
        effects, element = scene.get_effects_on(self.anatomy), self.choose_element(scene)
        return build_fem(self.anatomy, effects, accuracy, self.device, batch, element, live)

    def choose_element(self, scene: Scene) -> str:
        """Return the element type of a scene, or else the recommended element type for the mesh."""
        return scene.element or recommend_element(self.anatomy.mesh)

    def build_deformer(self, name: str, scene: Scene) -> Deformer:
        """Build the deformer `name` for a scene; FEM solves with the scene's accuracy.

        Raises
        ------
        InputError
            A name is unknown, a model was trained with other effects, tissue or element, or an effect is not supported.
        """
        if name == "fem":
            return self.build_fem(scene, scene.accuracy, live=True)
        if name in FAMILIES:
            wanted = scene.get_effects_on(self.anatomy), find_device(self.device, LIVE.precision).name, scene.accuracy
            if (key := repr((name, *wanted))) not in self.families:
                self.families[key] = build_family(name, self.anatomy, *wanted)
            return self.families[key]
        allowed = ", ".join(self.list_deformers(scene))
        if name == GUARDED and self.select_models(scene) and not self._can_guard(scene):
            raise InputError(
                f"{self.select_best(scene)} cannot be {GUARDED} in the scene {scene.name}: its tissue relaxes, so that "
                f"finite elements would have to solve from the first frame on. Choose one of {allowed}."
            )
        if name == GUARDED and self._can_guard(scene):
            model, limit = self.models[self.select_best(scene)], self.limit_of(scene)
            return Guarded(model, self.build_fem(scene, scene.accuracy, live=True), limit)
        if name == GUARDED and self.models:
            reason = next(iter(self.list_rejections(scene).values()))
            raise InputError(
                f"no model that {GUARDED} could ask knows the scene {scene.name}: {reason}. Choose {allowed}."
            )
        if name not in self.models:
            raise InputError(
                f"no deformer is called {name!r} here: choose one of {allowed}; `sulcus train` makes the trained ones. "
                f"Other families: {', '.join(FAMILIES)}."
            )
        reason = self.list_rejections(scene)[name]
        if reason is not None:
            raise InputError(f"{name} does not know the scene {scene.name}: {reason}. Choose one of {allowed}.")
        return self.models[name]

    def build_player(self, name: str, scene: Scene) -> Player:
        """Build a player of a scene on this anatomy, with the deformer `name`.

        Raises
        ------
        InputError
            See `build_deformer`; also if the anatomy has no open cortex.
        """
        return self.build_player_of(self.build_stage(scene), self.build_deformer(name, scene), name)

    def build_player_of(self, stage: Stage, deformer: Deformer, name: str) -> Player:
        """Build a player of a stage with a built deformer of this `name`, and with recorded errors on this anatomy."""
        ensemble, motion_error = self.estimate_uncertainty(stage.scene), self.estimate_motion_error(stage.scene)
        recorded = self.select_recorded(stage.scene).get(name)
        return Player(stage, deformer, uncertainty=ensemble, motion_error=motion_error, recorded=recorded)

    def estimate_uncertainty(self, scene: Scene) -> Uncertainty | None:
        """Return the expected error of the tumour position in a scene; None if no ensemble of this scene is stored."""
        found = self.uncertainties.get(scene.name)
        return found if found and found.mark == self.compute_mark(scene) else None

    def find_effect_record(self, scene: Scene) -> EffectRecord | None:
        """Return the recorded costs of a scene's effects; None if no record has the mark of this scene and anatomy."""
        found = self.effect_records.get(scene.name)
        return found if found and found.mark == self.compute_mark(scene) else None

    def select_recorded(self, scene: Scene) -> dict[str, FamilyFigures]:
        """Return recorded figures by family; empty unless the scene is a tool force on this tissue, fixed to bone."""
        kinds = {type(effect): str(effect) for effect in scene.get_effects_on(self.anatomy)}
        pushed = {*kinds, Bonded} == {Elasticity, Held, Bonded, ToolForce}
        return {name: one for name, one in self.family_figures.items() if pushed and one.tissue == kinds[Elasticity]}

    def compute_mark(self, scene: Scene) -> str:
        """Compute the hash that identifies a scene on this anatomy."""
        return compute_scene_mark(scene, self.site, self.choose_element(scene))

    def estimate_motion_error(self, scene: Scene) -> MotionError | None:
        """Return the position error as a share of the motion, fitted to the ensemble of this anatomy or the template.

        Returns None if the scene is not built-in, has other effect types than the built-in scene, or has no ensemble.
        """
        found = self.uncertainties.get(scene.name) or read_template_uncertainties().get(scene.name)
        if found is None or scene.name not in SCENES:
            return None
        kinds = [[type(effect) for effect in one.effects] for one in (scene, find_scene(scene.name))]
        return fit_motion_error(found) if kinds[0] == kinds[1] else None

    # Former names, for one release.
    stage, knowing, names, best = build_stage, select_models, list_deformers, select_best
    usual, described, fem, deformer = select_default, describe_deformer, build_fem, build_deformer
    player, uncertainty = build_player, estimate_uncertainty


@dataclass(frozen=True, eq=False)
class RestDeformer:
    """Deformer that returns no motion: the brain stays undeformed, as in the scan."""

    anatomy: Anatomy

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        """Return zero displacements for any loads, at all vertices or at the vertices `at`; see `build_start`."""
        rest = build_start(np.zeros((len(loads), *self.anatomy.mesh.nodes.shape)))
        return rest if at is None else rest.restrict(at)


@lru_cache(1)
def read_template_uncertainties() -> Mapping[str, Uncertainty]:
    """Return the shipped uncertainties of the template, by scene."""
    return read_uncertainties(to_uncertainty_path(get_template_path()))


def describe_solvers(deformer: Deformer) -> tuple[str, ...]:
    """List sentences on the solvers that an intact `Fem` tries for a load; empty for any other deformer."""
    return deformer.plan.explain() if isinstance(deformer, Fem) else ()


def to_model_path(anatomy: Path, scene_name: str = "model") -> Path:
    """Return the path of models next to MESH.vtu: MESH.model.npz by default, MESH.SCENE.npz for models of one scene."""
    return anatomy.with_suffix(f".{scene_name}.npz")


def load_models(path: Path, anatomy: Anatomy) -> dict[str, Learned]:
    """Load the models in the files next to an anatomy, by name; models of a single scene are called NAME-SCENE.

    Raises
    ------
    InputError
        Files are not readable or not consistent.
    """
    found: dict[str, Learned] = {}
    for kind in ("model", *SCENES):
        file = to_model_path(path, kind)
        for name, model in (load(file, anatomy) if file.is_file() else {}).items():
            found[name if kind == "model" else f"{name}-{kind}"] = model
    return found


def open_theatre(
    anatomy: Path | None = None, model: Path | None = None, device: str = "auto", scenes: Sequence[str] = ()
) -> PatientSetup:
    """Read an anatomy (default: the shipped template) with the files next to it: scan, models, uncertainties.

    `scenes`: names of the scenes to be played. `model`: another file with models.

    Raises
    ------
    InputError
        A scene is unknown (checked first, see `check_scene_exists`), a file is missing, not readable or not consistent,
        or the device is not available.

    Examples
    --------
    >>> from scenes import find_scene, open_theatre
    >>> theatre = open_theatre(device="cpu")
    >>> theatre.list_deformers(find_scene("press"))
    ('linear', 'ann', 'svr', 'series', 'series-gp', 'guarded', 'fem')
    """
    for name in scenes:
        check_scene_exists(name)
    # Trained models alone would not detect this, and the FEM fallback would fail too late.
    find_device(device, LIVE.precision)
    path = get_template_path() if anatomy is None else Path(anatomy)
    body = read_anatomy(path)
    scan = to_intensity_path(path)
    models = load_models(path, body) if model is None else load(Path(model), body)
    intensity = read_intensity(scan) if scan.is_file() else None
    uncertainties = read_uncertainties(to_uncertainty_path(path))
    records = read_effect_records(path.with_suffix(SUFFIX))
    figures = read_family_figures(path, body.digest)
    return PatientSetup(
        body, intensity, models, device, to_locator_path(path), uncertainties,
        effect_records=records, family_figures=figures,
    )  # fmt: skip
