"""Definition of a scene: effects, scripted tool, camera, solver accuracy, and limits of the metrics."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from numbers import Real
from operator import attrgetter
from pathlib import Path as FilePath
from typing import Any, cast

import numpy as np

from sim.accuracy import LIVE, Accuracy
from sim.anatomy import Anatomy
from sim.bodies.open_cortex import Place
from sim.effects import (
    Bonded,
    Effect,
    Elasticity,
    Gravity,
    Held,
    Resection,
    Retraction,
    SkullContact,
    ToolContact,
    ToolForce,
)
from sim.errors import InputError
from sim.loads import Cause, Loads, Pushed, Resected, Retracted, Touching
from sim.material import Material, Tissue
from sim.runtime.user_script import format_script_error, run_script

from .craniotomy_frame import CraniotomyFrame
from .debulking import Debulking
from .head_pose import Lie, get_supine_pose
from .observation_models import PointObservation, StereoObservation
from .registration import Registration
from .tool import Instrument, Probe
from .tool_paths import IDLE_HEIGHT, Path, Touch, keep_idle
from .viewpoint import NATURAL_APPEARANCE, USUAL_VIEWPOINT, Appearance, Viewpoint

MAX_FRAMES = 108_000  # Maximum number of frames of a scene: one hour at 30 frames/s.


@dataclass(frozen=True)
class Bounds:
    """Limits of a scene's metrics.

    Parameters
    ----------
    overlap
        Minimum intersection over union of the silhouettes of the drawn tumour and the FEM tumour.
    error
        Maximum mean distance between the drawn tumour and the FEM tumour [m].
    pixels
        Maximum distance between the projections by the scene's camera and by OpenCV [pixel].
    drawn
        Maximum distance between the outline in the image and the outline by FEM [pixel]; in a scene with an
        observation model, the outline computed from the estimate.
    visible
        Minimum share of the tumour's silhouette that drape and bone leave visible.
    covered, removed
        For a scene with an observation model: minimum share of frames whose ellipsoid contains the true tumour
        centroid, and minimum of 1 - (sum of errors) / (sum of tumour motions), over all frames.
    """

    overlap: float = 0.95
    error: float = 0.3e-3
    pixels: float = 1e-3
    drawn: float = 2.0
    visible: float = 0.5
    covered: float = 0.9
    removed: float = 0.0


PALPATION = Probe()  # Default tool.
STOP_TOLERANCE = (
    0.1e-3  # Largest distance by which the bone's edge may stop a tool before its target without a notice [m].
)
TOOL_EFFECTS = (ToolForce, ToolContact, Retraction)
"""Effects that need a tool."""


@dataclass(frozen=True)
class Scene:
    """Scripted scene: effects, tool and camera as functions of time [s]. The effects determine the loads at a time.

    Parameters
    ----------
    path, tool
        Motion of the tool, and the tool; None: scene without tool.
    lying
        Head pose as a function of time, used by `Gravity`.
    surgery
        Schedule of a resection; None: no resection.
    observation_model
        Observation model of the open cortex, from which the tumour position is estimated; the deformer's solution is
        then the ground truth. None: the tumour position is predicted by the deformer.
    registration
        Registration of the scan to the patient: "perfect", as in simulated images, or "clinical".
    deformer
        Name of the default deformer: a model family, or a trained model that supports the scene. None: the model with
        the smallest error bound, with FEM as fallback if the bound is weak.
    element
        Element type, a key of `sim.elements.ELEMENTS`; None: the recommended type for the mesh.

    Raises
    ------
    InputError
        An effect needs a tool but the scene has none, duration or frame rate is not a number > 0, or there are more
        than `MAX_FRAMES` frames.
    """

    name: str
    title: str
    path: Path = keep_idle
    duration: float = 4.0
    effects: tuple[Effect, ...] = (Elasticity(), Held(), Bonded(), ToolForce())
    tool: Instrument | None = PALPATION
    lying: Lie = get_supine_pose
    surgery: Debulking | None = None
    observation_model: PointObservation | StereoObservation | None = None
    viewpoint: Viewpoint = USUAL_VIEWPOINT
    look: Appearance = NATURAL_APPEARANCE
    registration: Registration = "perfect"
    deformer: str | None = None
    element: str | None = None
    accuracy: Accuracy = LIVE
    bounds: Bounds = Bounds()
    frames_per_second: float = 30.0

    def __post_init__(self) -> None:
        for name in ("duration", "frames_per_second"):
            number = getattr(self, name)
            if not isinstance(number, Real) or not 0.0 < float(number) < np.inf:
                raise InputError(f"the scene {self.name} has {name} {number!r}: give a number above 0.")
        if float(self.duration) * float(self.frames_per_second) > MAX_FRAMES:
            raise InputError(
                f"the scene {self.name} lasts {self.duration:g} s at {self.frames_per_second:g} frames a second: "
                f"that is more than {MAX_FRAMES:,} frames. Give a shorter duration, or fewer a second."
            )
        needs = [type(effect).__name__ for effect in self.effects if isinstance(effect, TOOL_EFFECTS)]
        if self.tool is None and needs:
            raise InputError(
                f"the scene {self.name} asks for {needs[0]}, but has no tool: give it one, or leave it out."
            )

    def replace_tissue(self, tissue: Tissue | None, element: str | None) -> Scene:
        """Return the scene with another tissue, another element type, or both (None: unchanged).

        Raises
        ------
        InputError
            The scene's tissue relaxes, and the law of the new tissue has no relaxation. (The Prony series is kept.)
        """
        if tissue is None:
            return self if element is None else replace(self, element=element)

        def change(effect: Effect) -> Effect:
            if not isinstance(effect, Elasticity):
                return effect
            relaxes = () if effect.default is None else effect.default.prony
            series = {"prony": relaxes} if relaxes and not tissue.prony else {}
            return replace(effect, default=replace(cast(Any, tissue), **series))

        return replace(self, effects=tuple(change(effect) for effect in self.effects), element=element or self.element)

    @property
    def elasticity(self) -> Elasticity:
        """Tissue of the scene; an `Elasticity` without material laws if the scene has no tissue."""
        return next((effect for effect in self.effects if isinstance(effect, Elasticity)), Elasticity(None))

    def replace_regions(self, regions: Mapping[int, Tissue]) -> Scene:
        """Return the scene with other tissues of some regions, given by label."""

        def change(effect: Effect) -> Effect:
            own = isinstance(effect, Elasticity)
            return replace(effect, regions={**effect.regions, **regions}) if own else effect

        return replace(self, effects=tuple(map(change, self.effects))) if regions else self

    @property
    def times(self) -> np.ndarray:
        """Times (n,) [s] of all frames."""
        return np.arange(round(self.duration * self.frames_per_second) + 1) / self.frames_per_second

    @property
    def max_depth(self) -> float:
        """Largest depth of the scripted tool over all frames [m]."""
        return max(self.path(time).depth for time in self.times.tolist())

    def get_effects_on(self, anatomy: Anatomy) -> tuple[Effect, ...]:
        """Return the effects on an anatomy, with the resection, and without skull contact if there is no skull."""
        gone = () if anatomy.slide_normal.any() else (SkullContact,)
        kept = tuple(effect for effect in self.effects if not isinstance(effect, gone))
        return kept if self.surgery is None else (*kept, _build_resection(self.surgery, anatomy))

    def find_contact(self, site: CraniotomyFrame, touch: Touch) -> Place:
        """Return the material point of the cortex that the tool touches at a tool input."""
        assert self.tool is not None
        return site.find_contact(touch.x, touch.y, self.tool.radius)

    @property
    def posed(self) -> bool:
        """True if the pose of the tool is prescribed instead of its force."""
        return any(isinstance(effect, ToolContact | Retraction) for effect in self.effects)

    def compute_tip(self, site: CraniotomyFrame, touch: Touch) -> np.ndarray:
        """Compute the tip (3,) [m] of a tool with prescribed pose, limited by the craniotomy edge."""
        assert self.tool is not None
        asked = self.find_contact(site, touch).point + touch.depth * site.compute_direction(touch)
        return site.clip_to_opening(asked, self.tool.radius)

    def describe_stop(self, site: CraniotomyFrame, touch: Touch) -> str:
        """Describe by how much the bone's edge stops the tool before its target; empty if the target is reached."""
        if self.tool is None:
            return ""
        asked = site.origin + touch.x * site.right + touch.y * site.up
        if self.posed:
            asked = asked + touch.depth * site.compute_direction(touch)
        beyond = float(site.compute_axis_distance(asked[None])[0]) - site.compute_reach(self.tool.radius)
        return f"the bone's edge stops the tool {1e3 * beyond:.1f} mm short" if beyond > STOP_TOLERANCE else ""

    def compute_pose(self, site: CraniotomyFrame, touch: Touch) -> np.ndarray:
        """Compute T_world_tool (4, 4) of a tool with prescribed pose, which faces along the craniotomy's axis."""
        assert self.tool is not None
        return self.tool.pose(self.compute_tip(site, touch), site.axis, site.right)

    def build_loads(self, site: CraniotomyFrame, touch: Touch, time: float) -> Loads:
        """Build one load case at a time [s], which contains the loads of all effects for this tool input."""
        causes = (self._build_cause(effect, site, touch, time) for effect in self.get_effects_on(site.anatomy))
        return Loads(tuple(cause for cause in causes if cause is not None), np.array([time]))

    def _build_cause(self, effect: Effect, site: CraniotomyFrame, touch: Touch, time: float) -> Cause | None:
        """Build the load of an effect at a time [s]; None if the effect has no load."""
        match effect:
            case ToolForce():
                return self._build_pushed(site, touch)
            case Resection():
                assert self.surgery is not None
                return Resected(np.array([self.surgery.count_done(time)]))
            case ToolContact():
                return Touching(self.compute_pose(site, touch)[None, None])
            case Retraction():
                laid = self.compute_pose(site, replace(touch, depth=-IDLE_HEIGHT))
                return Retracted(laid[None], (self.compute_pose(site, touch) - laid)[None, :3, 3])
            case Gravity():
                return self.lying(time).build_posture(site.anatomy.mesh.nodes)
            case _:
                return None

    def _build_pushed(self, site: CraniotomyFrame, touch: Touch) -> Pushed:
        assert self.tool is not None
        force = touch.force * site.compute_direction(touch)
        return Pushed(self.find_contact(site, touch).point[None], force[None], np.array([self.tool.radius]))

    # Former names, for one release.
    made_of, contact, tip, stopped = replace_tissue, find_contact, compute_tip, describe_stop
    pose, loads, sight = compute_pose, build_loads, property(attrgetter("observation_model"))


@lru_cache(8)
def _build_resection(surgery: Debulking, anatomy: Anatomy) -> Resection:
    """Build a resection; the result is cached because every frame needs the resection."""
    return surgery.build_resection(anatomy)


SCENES = (
    "spatula", "press", "slide", "draw", "palpate", "retract", "brain_shift", "resection", "pulsation", "sag",
    "lost_force", "microscope",
)  # fmt: skip
"""Names of the built-in scenes, each a module of `scenes.builtin` that exports SCENE."""


def find_scene(name: str) -> Scene:
    """Return a built-in scene by name, or the object SCENE of a Python file by its path, which ends in .py.

    The file is executed as Python code, with all rights of the user.

    Raises
    ------
    InputError
        No scene has this name. The file is missing, raises an exception, or has no SCENE. The scene's path does not
        return a `Touch`, or its tissue fails `sim.check_tissue`.

    Examples
    --------
    >>> from scenes import find_scene
    >>> scene = find_scene("press")
    >>> scene.duration, round(scene.path(2.0).force, 1)  # [s], [N]
    (4.0, 0.3)
    """
    check_scene_exists(name)
    if name.endswith(".py"):
        return _read_own_scene(name)
    return importlib.import_module(f"scenes.builtin.{name}").SCENE


def check_scene_exists(name: str) -> None:
    """Raise InputError if a name is no built-in scene and does not end in .py. No file is executed or read."""
    if name not in SCENES and not name.endswith(".py"):
        raise InputError(
            f"no scene is called {name!r}: choose one of {', '.join(SCENES)}, or name a file of your own, MY_SCENE.py."
        )


def _read_own_scene(path: str) -> Scene:
    from sim.terms.laws.conformance import check_tissue

    found = getattr(run_script(path), "SCENE", None)
    if found is None:
        raise InputError(f"{path}: has no SCENE. Let it say SCENE = Scene(...), as the built-in scenes do.")
    if not isinstance(found, Scene):
        raise InputError(f"{path}: its SCENE is a {type(found).__name__}. Make it a scenes.Scene.")
    for time in found.times.tolist():
        try:
            touch = found.path(time)
        except Exception as error:
            raise InputError(format_script_error(FilePath(path).absolute(), error)) from error
        if not isinstance(touch, Touch):
            kind = type(touch).__name__
            raise InputError(f"{path}: at {time:g} s its path gives a {kind}. Make it a scenes.Touch.")
    for effect in found.effects:
        if isinstance(effect, Elasticity):
            for tissue in (effect.default, *effect.regions.values()):
                if tissue is not None and type(tissue) is not Material:  # our own law is tested
                    try:
                        check_tissue(tissue)
                    except InputError as error:
                        raise InputError(f"{path}: {error} docs/extend.md says what a law is held to.") from error
    return found
