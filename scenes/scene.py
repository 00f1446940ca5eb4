"""What a scene is: effects, a scripted tool, a camera, an accuracy and the bounds that its figures must keep."""

from __future__ import annotations

import importlib
from dataclasses import dataclass

import numpy as np

from ar.camera import Camera, look_at
from sim.accuracy import LIVE, Accuracy
from sim.effects import Effect, Elasticity, Held, Slide, ToolForce
from sim.errors import InputError
from sim.loads import Loads, Pushed

from .paths import Path, Touch
from .site import Contact, Site
from .tool import Probe


@dataclass(frozen=True)
class Viewpoint:
    """A camera by its place relative to the open cortex.

    distance [m] along the outward normal; tilt [rad] of the line of sight towards the site's `up`; vertical field of
    view [rad]; size of the picture [pixel].
    """

    distance: float = 0.20
    tilt: float = -0.35
    fov: float = np.radians(22.0)
    width: int = 640
    height: int = 480

    def camera(self, site: Site) -> Camera:
        """The camera that looks at a site."""
        outward = -np.cos(self.tilt) * site.axis + np.sin(self.tilt) * site.up
        return look_at(site.origin + self.distance * outward, site.origin, site.up, self.fov, self.width, self.height)


@dataclass(frozen=True)
class Bounds:
    """What the figures of a scene must keep for it to pass.

    Parameters
    ----------
    overlap
        Least intersection over union of the drawn tumour's silhouette and the finite elements'.
    error
        Largest mean distance between the predicted tumour and the finite elements' [m].
    pixels
        Largest difference between our projection and OpenCV's [pixel].
    """

    overlap: float = 0.95
    error: float = 0.3e-3
    pixels: float = 1e-3


PALPATION = Probe()


@dataclass(frozen=True)
class Scene:
    """One scripted scene. Times in seconds.

    `element` is one of `sim.discretisation.ELEMENTS`; None: p1, or p2 on a mesh that brings mid-edge nodes. Learnt
    models are played and judged with the tissue and the element that they were taught, whatever the scene says.
    """

    name: str
    title: str
    path: Path
    duration: float
    effects: tuple[Effect, ...] = (Elasticity(), Held(), Slide(), ToolForce())
    tool: Probe = PALPATION
    viewpoint: Viewpoint = Viewpoint()
    element: str | None = None
    accuracy: Accuracy = LIVE
    bounds: Bounds = Bounds()
    frames_per_second: float = 30.0

    @property
    def times(self) -> np.ndarray:
        """Time of every frame (n,) [s]."""
        return np.arange(round(self.duration * self.frames_per_second) + 1) / self.frames_per_second

    def contact(self, site: Site, touch: Touch) -> Contact:
        """The material point that the tool touches."""
        return site.contact(touch.x, touch.y, self.tool.radius)

    def loads(self, site: Site, touch: Touch, time: float) -> Loads:
        """One load case: the tool at a place of the site."""
        contact = self.contact(site, touch)
        force = touch.force * site.direction(touch)
        return Loads((Pushed(contact.point[None], force[None], np.array([self.tool.radius])),), np.array([time]))


SCENES = ("press", "slide", "retract")
"""The built-in scenes, each a module of this room that exports SCENE."""


def find_scene(name: str) -> Scene:
    """A built-in scene.

    Raises
    ------
    InputError
        No scene of that name.
    """
    if name not in SCENES:
        raise InputError(f"no scene is called {name!r}: choose one of {', '.join(SCENES)}.")
    return importlib.import_module(f"scenes.{name}").SCENE
