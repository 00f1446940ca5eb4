"""Surgical tools of scenes: contact shape, rendered surface and pose."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
import trimesh

from sim.tools import Ball, BuiltIn, Spatula, Tool, get_core

SHAFT_RADIUS = 1.8e-3  # Default radius of a tool's shaft [m].


def build_sphere(subdivisions: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Return a sphere of radius 1: vertices (n, 3), and triangles (m, 3) with outward orientation."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    return np.asarray(ball.vertices), np.asarray(ball.faces)


def build_capsule(radius: float, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a capsule that starts at the origin and extends along +z: vertices (n, 3) [m] and triangles (m, 3)."""
    rod = trimesh.creation.capsule(length, radius, count=(20, 20))
    rod.apply_translation([0.0, 0.0, -float(rod.bounds[0, 2])])
    return np.asarray(rod.vertices), np.asarray(rod.faces)


def add_shaft(shape: BuiltIn, shaft_end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface of a tool's contact shape, with a straight shaft from its centre to `shaft_end` (3,) [m].

    Returns vertices (n, 3) [m] in tool coordinates, and triangles (m, 3).
    """
    core = get_core(shape)
    ball = core.radius * build_sphere(3)[0]
    head = trimesh.convex.convex_hull((core.corners[:, None] + ball).reshape(-1, 3))
    shaft = trimesh.creation.cylinder(SHAFT_RADIUS, segment=[core.centre, shaft_end], sections=24)
    both = head + shaft
    return np.asarray(both.vertices), np.asarray(both.faces)


class Instrument(Protocol):
    """Interface of a scene's tool: `Probe`, `Blade`, or an instrument of your own as a frozen dataclass.

    In tool coordinates [m], the lowest point of the tool is the origin, and the shaft points along +z.
    """

    @property
    def radius(self) -> float:
        """Radius of the footprint of a pushing tool, and of the space around the tip inside the craniotomy [m]."""
        ...

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """Surface mesh for rendering in tool coordinates; each frame reads this property."""
        ...

    @property
    def shape(self) -> Tool:
        """Contact shape, for `ToolContact`."""
        ...

    def pose(self, tip: np.ndarray, inward: np.ndarray, aside: np.ndarray) -> np.ndarray:
        """Return T_world_tool (4, 4) of a tool that touches `tip` (3,) [m]; unit vectors `inward` and `aside` (3,)."""
        ...


@dataclass(frozen=True)
class Probe:
    """Palpation tool: a ball on a shaft.

    Parameters
    ----------
    radius
        Radius of the ball, and of the ball's footprint on the tissue [m].
    shaft
        Radius of the shaft [m], in the plain appearance.
    length
        Length of the shaft [m], in the plain appearance.
    lean, turn
        Angle between the shaft and the outward normal, and azimuth of the shaft about the normal [rad]; azimuth 0 is
        the direction `aside` of `pose`.
    """

    radius: float = 7e-3
    shaft: float = 1.8e-3
    length: float = 0.14
    lean: float = 0.75
    turn: float = field(default=0.0, repr=False)  # fingerprints use the repr of a tool

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """Surface in tool coordinates [m]: the lowest point of the ball is the origin, the shaft points along +z."""
        ball = trimesh.creation.icosphere(subdivisions=3, radius=self.radius)
        ball.apply_translation([0.0, 0.0, self.radius])
        shaft = trimesh.creation.cylinder(self.shaft, self.length, sections=24)
        shaft.apply_translation([0.0, 0.0, self.radius + 0.5 * self.length])
        radius, start = self.grip
        grip = trimesh.creation.capsule(0.6 * self.length, radius, count=(16, 24))
        grip.apply_translation([0.0, 0.0, self.radius + start])
        return ball + shaft + grip

    @property
    def grip(self) -> tuple[float, float]:
        """Radius of the grip, and distance of the grip from the centre of the ball [m]."""
        return 2.2 * self.shaft, 0.55 * self.length

    @property
    def shape(self) -> Ball:
        """Contact shape."""
        return Ball(self.radius)

    def pose(self, tip: np.ndarray, inward: np.ndarray, aside: np.ndarray) -> np.ndarray:
        """Return T_world_tool (4, 4): the ball touches `tip` (3,) [m] from outside; the shaft leans towards `aside`.

        A positive `turn` rotates the shaft from `aside` towards `aside` x `inward`, which are unit vectors (3,). The
        ball rotates about its centre, so that the contact does not depend on `lean`.
        """
        centre = tip - self.radius * inward
        aside = np.cos(self.turn) * aside + np.sin(self.turn) * np.cross(aside, inward)
        shaft = -np.cos(self.lean) * inward + np.sin(self.lean) * aside
        across = np.cross(inward, aside)
        T = np.eye(4)
        T[:3, :3] = np.column_stack([np.cross(across, shaft), across, shaft])
        T[:3, 3] = centre - self.radius * shaft
        return T


@dataclass(frozen=True)
class Blade:
    """Brain spatula: a flat blade with a round edge, and an arm that leads upwards from one end.

    Parameters
    ----------
    width, length
        Width and length of the blade [m].
    edge
        Radius of the edge [m]; the thickness of the blade is 2 `edge`.
    arm
        Length of the arm [m], in the plain appearance.
    """

    width: float = 0.012
    length: float = 0.026
    edge: float = 1.5e-3
    arm: float = 0.12

    @property
    def radius(self) -> float:
        """Circumscribed radius around the tip [m]: the space that the blade needs inside the craniotomy."""
        return 0.5 * float(np.hypot(self.width, self.length))

    @property
    def shape(self) -> Spatula:
        """Contact shape."""
        return Spatula(self.width, self.length, self.edge)

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """Surface in tool coordinates [m]: the blade's lower face contains the origin, the arm points along +z."""
        core = get_core(self.shape)
        ball = trimesh.creation.icosphere(subdivisions=2, radius=self.edge).vertices
        corners = core.centre + core.half * np.array([[x, y, 0.0] for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
        blade = trimesh.convex.convex_hull((corners[:, None] + ball).reshape(-1, 3))
        arm = trimesh.creation.box([0.5 * self.width, 2.0 * self.edge, self.arm])
        arm.apply_translation([0.0, 0.5 * self.length - self.edge, 0.5 * self.arm])
        return blade + arm

    def pose(self, tip: np.ndarray, inward: np.ndarray, aside: np.ndarray) -> np.ndarray:
        """Return T_world_tool (4, 4): the blade's face at `tip` (3,) [m] faces `inward`; its width is along `aside`."""
        T = np.eye(4)
        T[:3, :3] = np.column_stack([aside, np.cross(-inward, aside), -inward])
        T[:3, 3] = tip
        return T
