"""Who can play: an anatomy with its scan, and the deformers that know it, by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from sim.accuracy import LIVE, Accuracy
from sim.anatomy import Anatomy, region_words
from sim.bodies.intensity import Intensity, read_intensity, sidecar
from sim.bodies.meshfile import read_anatomy
from sim.deformation import Deformation, Deformer, guess
from sim.discretisation.space import recommended
from sim.effects import Elasticity
from sim.errors import InputError
from sim.fem import Fem, solver_named
from sim.loads import Loads
from sim.resected_fem import Operated, finite_elements
from sim.runtime.device import find_device
from surrogate.data.answer_rows import first_stated
from surrogate.locating.locator import Locator
from surrogate.locating.locator_store import load_locator, locator_path
from surrogate.locating.regions import differing
from surrogate.model.applicability import refusal
from surrogate.model.guarded import Guarded, off_by
from surrogate.model.learned import Learned
from surrogate.model.left_out import LIMIT
from surrogate.model.store import load

from ..script.scene import Scene, demand_scene
from ..script.shipped_files import template_path
from ..script.sight import Sight, StereoSight
from ..script.site import Site, site_of
from ..script.uncertainty import Uncertainty, mark_of, read_uncertainties, uncertainty_path
from .observer import Observer
from .player import Player
from .stage import Stage
from .stereo_observer import StereoObserver

GUARDED = "guarded"
"""The name of the best model with finite elements behind it."""
TRUTH = "what an estimate is held against is the truth, as finite elements have it"


@dataclass(frozen=True, eq=False)
class Theatre:
    """An anatomy, its T1 scan if there is one, models by name, learnt from one data set, and uncertainties by scene.

    `locator_file` is where the locator of its tumour is, for scenes with a sight. `limit` [m] is that of a guarded
    model; None: the one that its own errors on left-out cortex ask for.
    """

    anatomy: Anatomy
    intensity: Intensity | None
    models: Mapping[str, Learned]
    device: str = "auto"
    locator_file: Path | None = None
    uncertainties: Mapping[str, Uncertainty] = field(default_factory=dict)
    limit: float | None = None

    @cached_property
    def site(self) -> Site:
        """The open cortex."""
        return site_of(self.anatomy)

    @cached_property
    def locator(self) -> Locator:
        """What locates its tumour.

        Raises
        ------
        InputError
            There is no such file, or it is of another anatomy.
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
        """What its models learned from, with the tissue of regions; None where none states it.

        Raises
        ------
        InputError
            A statement that is no tissue.
        """
        return first_stated(model.training for model in self.models.values())

    def lacks_locator(self, scene: Scene) -> bool:
        """Whether a scene has a sight, and no locator lies beside this anatomy."""
        return scene.sight is not None and (self.locator_file is None or not self.locator_file.is_file())

    def stage(self, scene: Scene) -> Stage:
        """A scene's stage on this anatomy, drawn on this theatre's device.

        Raises
        ------
        InputError
            A scene with a sight, on an anatomy without a locator, or with one that knows regions otherwise.
        """
        device = find_device(self.device, LIVE.precision).name
        if scene.sight is not None and (unlike := differing(scene.elasticity, self.locator.regions)):
            raise InputError(
                f"{scene.name}: the locator at {self.locator_file} knows another stiffness of "
                f"{' and '.join(map(region_words, unlike))} than the scene has. Make it anew: `sulcus locator "
                "ANATOMY.vtu`, with the same --region."
            )
        stage = Stage(scene, self.site, self.intensity, device=device)
        match scene.sight:
            case None:
                return stage
            case Sight():
                return replace(stage, observer=Observer(self.site, self.locator, scene.sight))
            case StereoSight():
                return replace(stage, observer=StereoObserver(stage, self.locator, scene.sight))

    def refusals(self, scene: Scene) -> dict[str, str | None]:
        """Why each learnt model may not answer a scene, by name; None if it may.

        A model answers the effects, the tissue and the element that it learned from, and no others. None is the truth
        that an estimate is held against.
        """
        if scene.sight is not None:
            return dict.fromkeys(self.models, TRUTH)
        effects, element = scene.effects_on(self.anatomy), self.element_of(scene)
        return {name: refusal(model, effects, element) for name, model in self.models.items()}

    def knowing(self, scene: Scene) -> dict[str, Learned]:
        """The learnt models that may answer a scene, by name."""
        return {name: self.models[name] for name, why in self.refusals(scene).items() if why is None}

    def names(self, scene: Scene) -> tuple[str, ...]:
        """Every deformer that can be asked for a scene: learnt ones that know it, the best guarded, finite elements."""
        knowing = tuple(self.knowing(scene))
        return (*knowing, *([GUARDED] if self._guardable(scene) else []), "fem")

    def best(self, scene: Scene) -> str:
        """The learnt model of the tightest error bound; the finite elements where none knows the scene."""
        knowing = self.knowing(scene)
        return min(knowing, key=lambda name: knowing[name].bound, default="fem")

    def limit_of(self, scene: Scene) -> float:
        """Where finite elements answer behind the best model that knows a scene [m]."""
        stated = self.models[self.best(scene)].left_out
        if self.limit is not None:
            return self.limit
        return LIMIT if stated is None else stated.limit

    def usual(self, scene: Scene) -> str:
        """Who plays a scene unless somebody else is asked: the best model, guarded where it may not answer alone.

        A model of tissue that relaxes plays alone, with its bound: see `_guardable`.
        """
        name = self.best(scene)
        return GUARDED if self._guardable(scene) and off_by(self.models[name]).weak else name

    def _guardable(self, scene: Scene) -> bool:
        """Whether finite elements can stand behind the best model.

        Where tissue relaxes they cannot: a frame that the model hands over depends on all that it did not.
        """
        name = self.best(scene)
        return name in self.models and not self.models[name].series

    def described(self, name: str, scene: Scene) -> str:
        """A deformer by name, in words: what solves, or what it learned from."""
        solver = solver_named(self.element_of(scene), scene.effects)
        if name == GUARDED:
            model, limit = self.models[self.best(scene)], 1e3 * self.limit_of(scene)
            return f"{model.source}; where that may be over {limit:g} mm off, {solver}"
        return solver if name == "fem" else self.models[name].source

    def fem(self, scene: Scene, accuracy: Accuracy, batch: int = 64, live: bool = False) -> Fem | Operated:
        """Finite elements for a scene's effects, tissue and element; `live` as `Fem` has it."""
        effects, element = scene.effects_on(self.anatomy), self.element_of(scene)
        return finite_elements(self.anatomy, effects, accuracy, self.device, batch, element, live)

    def element_of(self, scene: Scene) -> str:
        """The element of a scene, or the one that is recommended for the mesh."""
        return scene.element or recommended(self.anatomy.mesh)

    def deformer(self, name: str, scene: Scene) -> Deformer:
        """A deformer by name; finite elements are made for the scene's accuracy.

        Raises
        ------
        InputError
            A name that this theatre does not know; a model that learned from other effects, tissue or element.
        """
        if name == "fem":
            return self.fem(scene, scene.accuracy, live=True)
        allowed = ", ".join(self.names(scene))
        if name == GUARDED and self.knowing(scene) and not self._guardable(scene):
            raise InputError(
                f"{self.best(scene)} cannot be {GUARDED} in the scene {scene.name}: its tissue relaxes, so that finite "
                f"elements would have to answer from the first frame on. Choose one of {allowed}."
            )
        if name == GUARDED and self._guardable(scene):
            model, limit = self.models[self.best(scene)], self.limit_of(scene)
            return Guarded(model, self.fem(scene, scene.accuracy, live=True), limit)
        if name == GUARDED and self.models:
            why = next(iter(self.refusals(scene).values()))
            raise InputError(
                f"no model that {GUARDED} could ask knows the scene {scene.name}: {why}. Choose {allowed}."
            )
        if name not in self.models:
            raise InputError(
                f"no deformer is called {name!r} here: choose one of {allowed}; `sulcus train` makes the trained ones."
            )
        why = self.refusals(scene)[name]
        if why is not None:
            raise InputError(f"{name} does not know the scene {scene.name}: {why}. Choose one of {allowed}.")
        return self.models[name]

    def player(self, name: str, scene: Scene) -> Player:
        """A scene on this anatomy's open cortex with a deformer by name.

        Raises
        ------
        InputError
            As `deformer`; an anatomy without open cortex.
        """
        return Player(self.stage(scene), self.deformer(name, scene), uncertainty=self.uncertainty(scene))

    def uncertainty(self, scene: Scene) -> Uncertainty | None:
        """How far the tumour may be off in a scene; None where no ensemble was solved of just this one."""
        found = self.uncertainties.get(scene.name)
        return found if found and found.mark == mark_of(scene, self.site, self.element_of(scene)) else None


@dataclass(frozen=True, eq=False)
class AtRest:
    """A Deformer that solves nothing: the body stays where the scan has it."""

    anatomy: Anatomy

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        """A guess that nothing moves, whatever acts."""
        rest = guess(np.zeros((len(loads), *self.anatomy.mesh.nodes.shape)))
        return rest if at is None else rest.at(at)


def plan_of(deformer: Deformer) -> tuple[str, ...]:
    """Which solvers a deformer tries for a load, in sentences; none of a model, or of a body that is operated on."""
    return deformer.plan.explain() if isinstance(deformer, Fem) else ()


def model_path(anatomy: Path) -> Path:
    """Where the models of an anatomy file are looked for: MESH.model.npz beside MESH.vtu."""
    return anatomy.with_suffix(".model.npz")


def open_theatre(
    anatomy: Path | None = None, model: Path | None = None, device: str = "auto", scenes: Sequence[str] = ()
) -> Theatre:
    """Read an anatomy (default: the template that ships) with what lies beside it: scan, models, uncertainties.

    `scenes` are names of those that will play there.

    Raises
    ------
    InputError
        As `demand_scene`, before anything is read. Files that are missing, unreadable, or do not belong together; a
        device that is not there.
    """
    for name in scenes:
        demand_scene(name)
    # Learnt models alone would not notice, and the finite elements behind them fail too late.
    find_device(device, LIVE.precision)
    path = template_path() if anatomy is None else Path(anatomy)
    body = read_anatomy(path)
    scan = sidecar(path)
    learnt = model_path(path) if model is None else Path(model)
    models = load(learnt, body) if model is not None or learnt.is_file() else {}
    intensity = read_intensity(scan) if scan.is_file() else None
    uncertainties = read_uncertainties(uncertainty_path(path))
    return Theatre(body, intensity, models, device, locator_path(path), uncertainties)
