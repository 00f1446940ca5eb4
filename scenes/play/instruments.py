"""Surgical instruments as visual shapes: their contact shape where they touch tissue, and a modelled upper part."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import trimesh
from scipy.interpolate import PchipInterpolator

from ar.rendering.layer import Layer
from sim.geometry.surface import normalise_vectors

from ..script.tool import Blade, Probe
from ..script.viewpoint import BallInstrument

STEEL = (0.48, 0.50, 0.53)  # Diffuse colour of steel (RGB, 0 to 1).
STEEL_LIGHT = 4.0, 40.0  # Gloss and shininess of round steel: a soft highlight.
BLADE_LIGHT = 1.5, 40.0  # Gloss and shininess of a flat blade: satin.
# Bright bands of the surroundings that metal reflects: direction in the tool's frame, and cosines of normals to it.
REFLECTED, BANDS = np.array([0.6, 0.69, 0.4]), (-0.2, 0.6)
SPATULA_BEND = 4e-3  # Radius of the bend at the end of a spatula's blade [m].
SPATULA_THICKNESS = 1.1e-3  # Thickness of a spatula's strip above the blade [m].
# Lengths [m] along a spatula's strip, and its angles above the blade there [rad].
SPATULA_ANGLES = (0.0, 5.5e-3, 16e-3, 30e-3), (0.0, 1.38, 1.38, 0.7)
INSULATION = (0.13, 0.22, 0.45)  # Colour of the coat of bipolar forceps (RGB, 0 to 1).
COTTON_COLOUR = (0.93, 0.90, 0.85)  # Colour of a wet cotton ball (RGB, 0 to 1).
SHARP_ANGLE = np.radians(40.0)  # Angle between faces above which their edge is shaded as sharp [rad].
STATION_STEP = 0.4  # Distance between the sections of a sweep [mm].
SECTIONS = 24  # Number of points of a round profile.
FIBRE_DEPTH = 0.2e-3  # Largest depth of the relief of a cotton ball [m].
CIRCLE = np.stack([f(np.linspace(0.0, 2.0 * np.pi, SECTIONS, endpoint=False)) for f in (np.cos, np.sin)], axis=1)

Colour = tuple[float, float, float]
Shapes = tuple[list[trimesh.Trimesh], list[Colour]]
"""Meshes [m] in a tool's frame, and their colours."""


@dataclass(frozen=True, eq=False)
class Part:
    """Part of one material in the tool's frame: vertices (n, 3) [m], triangles (m, 3), colours (n, 3), highlight."""

    vertices: np.ndarray
    triangles: np.ndarray
    colour: np.ndarray
    gloss: float
    shininess: float

    def build_layer(self, name: str, number: int, pose: np.ndarray) -> Layer:
        """Return the layer at T_world_tool `pose` (4, 4)."""
        at = self.vertices @ pose[:3, :3].T + pose[:3, 3]
        return Layer(name, number, at, self.triangles, self.colour, self.gloss, self.shininess, casts_shadow=True)


def sweep(profile: np.ndarray, stations: np.ndarray, wide: Sequence[float]) -> trimesh.Trimesh:
    """Sweep a profile along a smooth centre line: a closed surface [m], with edges that are shaded as sharp.

    Parameters
    ----------
    profile
        Points (k, 2) of a closed convex curve, counter-clockwise, along the wide axis and the normal.
    stations
        Rows (n, 5) [mm] along the centre line: point, and factors of the profile along both axes.
    wide
        Direction (3,) of the wide axis, not parallel to the centre line.
    """
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(stations[:, :3], axis=0), axis=1)))
    rows = 1e-3 * PchipInterpolator(way, stations)(np.linspace(0.0, way[-1], int(way[-1] / STATION_STEP) + 1))
    return loft(profile * rows[:, None, 3:], rows[:, :3], wide)


def loft(profiles: np.ndarray, centre: np.ndarray, wide: Sequence[float]) -> trimesh.Trimesh:
    """Join profiles (n, k, 2) [m] at the points (n, 3) [m] of a centre line; otherwise as `sweep`."""
    tangent = normalise_vectors(np.gradient(centre, axis=0))
    normal = normalise_vectors(np.cross(tangent, wide))
    rings = centre[:, None] + profiles @ np.stack([np.cross(normal, tangent), normal], axis=1)
    count, around = rings.shape[:2]
    a, b = (around * np.arange(count - 1)[:, None] + np.roll(np.arange(around), -k) for k in (0, 1))
    fan = np.stack([np.zeros(around - 2, int), np.arange(1, around - 1), np.arange(2, around)], axis=1)
    sides = [np.stack(each, axis=-1).reshape(-1, 3) for each in ((a, b, b + around), (a, b + around, a + around))]
    faces = np.concatenate([*sides, fan[:, ::-1], fan + around * (count - 1)])
    return trimesh.graph.smooth_shade(trimesh.Trimesh(rings.reshape(-1, 3), faces, process=False), SHARP_ANGLE)


def build_part(meshes: Sequence[trimesh.Trimesh], colours: Sequence[Colour], gloss: float, shininess: float) -> Part:
    """Join meshes, each with its colour, to a part of one highlight."""
    whole = trimesh.util.concatenate(meshes)
    along = np.asarray(whole.vertex_normals) @ REFLECTED
    bands = sum(np.exp(-(((along - at) / 0.15) ** 2)) for at in BANDS)
    colour = np.repeat(np.array(colours), [len(mesh.vertices) for mesh in meshes], axis=0)
    colour = np.clip(colour * (0.75 + 0.75 * np.reshape(bands, (-1, 1))), 0.0, 1.0)
    return Part(np.asarray(whole.vertices), np.asarray(whole.faces), colour, gloss, shininess)


@lru_cache(maxsize=8)
def build_instrument(tool: Probe | Blade, kind: BallInstrument) -> tuple[Part, ...]:
    """Build a brain spatula for a blade, and an instrument of a kind for a ball."""
    if isinstance(tool, Blade):
        return (build_part([build_spatula(tool)], [STEEL], *BLADE_LIGHT),)
    meshes, colours = BALL_INSTRUMENTS[kind](tool.radius)
    ball = trimesh.creation.icosphere(subdivisions=4, radius=tool.radius)
    ball.apply_translation([0.0, 0.0, tool.radius])
    if kind == "dissector":
        return (build_part([ball, *meshes], [STEEL, *colours], *STEEL_LIGHT),)
    return build_cotton(ball), build_part(meshes, colours, *STEEL_LIGHT)


def build_cotton(ball: trimesh.Trimesh) -> Part:
    """Turn a ball into wet cotton: fibres below its surface, which are darker."""
    deep = np.random.default_rng(5).uniform(size=len(ball.vertices))
    at = ball.vertices - FIBRE_DEPTH * deep[:, None] * ball.vertex_normals
    colour = np.array(COTTON_COLOUR) * (1.0 - 0.12 * deep[:, None])
    return Part(np.asarray(at), np.asarray(ball.faces), colour, gloss=0.15, shininess=20.0)


def build_spatula(blade: Blade) -> trimesh.Trimesh:
    """Build a brain spatula: the lower half of a blade, from whose end a thinner strip goes up and away."""
    edge, half = blade.edge, 0.5 * blade.length
    round_off = edge * np.sin(np.linspace(-0.48 * np.pi, 0.0, 9))
    flat = np.linspace(0.0, 2.0 * half - edge - SPATULA_BEND, 12)[1:]
    # Angles of the strip above the blade along its length: up over the edge of the craniotomy, then away.
    way = np.arange(0.0, 0.16, 0.7e-3)[1:]
    angle = np.interp(way, *SPATULA_ANGLES)
    y = np.concatenate([round_off + edge - half, edge - half + flat])
    y = np.append(y, y[-1] + np.cumsum(0.7e-3 * np.cos(angle)))
    z = np.append(np.full(len(round_off) + len(flat), edge), edge + np.cumsum(0.7e-3 * np.sin(angle)))
    thick = np.append(np.sqrt(edge**2 - round_off**2), np.full(len(flat), edge))
    thick = np.append(thick, np.interp(way, (0.0, SPATULA_BEND), (edge, SPATULA_THICKNESS)))
    wide = np.append(
        0.5 * blade.width - edge + thick[: -len(way)], np.interp(way, (0.0, 0.03), (0.5 * blade.width, 5e-3))
    )
    turn = np.linspace(np.pi, 2.0 * np.pi, 11)
    below = np.stack([np.cos(turn), np.sin(turn)], axis=1) * thick[:, None, None]
    below[..., 0] += np.sign(np.cos(turn).round(9)) * (wide - thick)[:, None]
    over = np.linspace(1.0, -1.0, 9)[1:-1]
    above = np.stack([wide[:, None] * over, -0.3 * thick[:, None] * (1.0 - over**2)], axis=2)
    return loft(np.concatenate([below, above], axis=1), np.stack([0.0 * y, y, z], axis=1), (1.0, 0.0, 0.0))


def build_dissector(radius: float) -> Shapes:
    """Build the thin neck and the ribbed grip of a blunt dissector, which ends in a ball of `radius` [m]."""
    ribs = np.arange(48.0, 100.0, 0.8)
    heights = np.concatenate([(0.0, 14.0, 37.0, 44.0), ribs, (102.0, 140.0)])
    radii = np.concatenate([(1.1, 1.1, 1.5, 2.5), 2.5 + 0.15 * (-1.0) ** np.arange(len(ribs)), (2.7, 2.7)])
    stations = np.stack([0.0 * heights, 0.0 * heights, heights, radii, radii], axis=1)
    return [sweep(CIRCLE, stations + lift(radius), (1.0, 0.0, 0.0))], [STEEL]


def build_forceps(radius: float) -> Shapes:
    """Build bayonet bipolar forceps that grip a ball of `radius` [m] near its top."""
    meshes = []
    for side in (-1.0, 1.0):
        grip = 0.3e3 * radius
        tip = [(0.0, side * grip, 0.4e3 * radius, 0.7, 0.5), (0.0, side * (grip + 1.5), 22.0, 1.3, 0.8)]
        coat = [
            (0.0, side * (grip + 1.5), 22.0, 1.5, 1.0), (0.0, side * (grip + 3.0), 55.0, 2.2, 1.2),
            (-3.0, side * (grip + 3.3), 65.0, 2.6, 1.4), (-12.0, side * (grip + 3.6), 78.0, 3.0, 1.5),
            (-14.0, side * (grip + 3.6), 90.0, 4.0, 1.5), (-14.0, side * 2.0, 160.0, 4.0, 1.5),
        ]  # fmt: skip
        meshes += [sweep(CIRCLE, np.array(each) + lift(radius), (1.0, 0.0, 0.0)) for each in (tip, coat)]
    return meshes, [STEEL, INSULATION] * 2


def build_suction(radius: float) -> Shapes:
    """Build an angled suction tube with a thumb plate, whose tip is in a ball of `radius` [m]."""
    tube = [
        (0.0, 0.0, 0.4e3 * radius, 1.5, 1.5), (0.0, 0.0, 36.0, 1.5, 1.5), (-2.0, 0.0, 44.0, 1.5, 1.5),
        (-6.0, 0.0, 50.0, 1.5, 1.5), (-14.0, 0.0, 58.0, 1.7, 1.7), (-70.0, 0.0, 114.0, 1.7, 1.7),
    ]  # fmt: skip
    plate = [
        (-7.0, 0.0, 53.0, 1.0, 0.5), (-9.0, 0.0, 55.0, 4.5, 0.8),
        (-17.0, 0.0, 63.0, 5.0, 0.8), (-21.0, 0.0, 67.0, 1.0, 0.5),
    ]  # fmt: skip
    hole = [(-10.0, 0.0, 58.0, 0.8, 0.3), (-12.0, 0.0, 60.0, 1.2, 0.3), (-14.0, 0.0, 62.0, 0.8, 0.3)]
    meshes = [sweep(CIRCLE, np.array(each) + lift(radius), (0.0, 1.0, 0.0)) for each in (tube, plate, hole)]
    return meshes, [STEEL, STEEL, (0.05, 0.05, 0.05)]


def lift(radius: float) -> tuple[float, float, float, float, float]:
    """Return the shift of stations [mm] from the centre of a ball of `radius` [m] to the tool's frame."""
    return 0.0, 0.0, 1e3 * radius, 0.0, 0.0


BALL_INSTRUMENTS: dict[BallInstrument, Callable[[float], Shapes]] = {
    "dissector": build_dissector, "forceps": build_forceps, "suction": build_suction,
}  # fmt: skip
