"""Rendered shapes of surgical instruments: the contact shape at the tissue, and a modelled upper part."""

from collections.abc import Sequence
from functools import lru_cache
from typing import TypeGuard, cast

import numpy as np
import trimesh
from scipy.interpolate import PchipInterpolator

from ar.rendering.layer import Layer
from sim.geometry.surface import normalise_vectors

from ..script.tool import Blade, Probe, build_sphere
from ..script.viewpoint import BallInstrument

# Colours (RGB, 0 to 1).
STEEL, INSULATION, DARK, COTTON = (0.48, 0.50, 0.53), (0.13, 0.22, 0.45), (0.05, 0.05, 0.05), (0.93, 0.90, 0.85)
STEEL_LIGHT = 4.0, 40.0  # Gloss and shininess of round steel: a soft highlight.
BLADE_LIGHT = 1.5, 40.0  # Gloss and shininess of a flat blade: satin.
# Bright bands of the surroundings that metal reflects: direction in the tool's frame, and cosines of normals to it.
REFLECTED, BANDS = np.array([0.6, 0.69, 0.4]), (-0.2, 0.6)
SHARP_ANGLE = np.radians(40.0)  # Angle between faces above which their edge is shaded as sharp [rad].
SECTIONS = 5  # Number of sections of a sweep from station to station.
CIRCLE = np.stack([f(np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False)) for f in (np.cos, np.sin)], axis=1)
FIBRE_DEPTH = 0.2e-3  # Largest depth of the relief of a cotton ball [m].
MIN_BALL_RADIUS = 2.9e-3  # Radius below which forceps and suction would not reach their ball [m].
SPATULA_BEND = 4e-3  # Radius of the bend at the end of a spatula's blade [m].
SPATULA_THICKNESS = 1.1e-3  # Thickness of a spatula's strip above the blade [m].
SPATULA_STEP = 0.7e-3  # Distance between the sections of that strip [m].
# Lengths [m] along a spatula's strip, and its angles above the blade there [rad]: up over the bone's edge, then away.
SPATULA_ANGLES = (0.0, 5.5e-3, 16e-3, 30e-3), (0.0, 1.38, 1.38, 0.7)
# Shapes of an instrument: colour, wide axis, and stations [mm] from the centre of its ball (see `build_sweep`).
RIBS = [(0.0, 0.0, 48.0 + 1.6 * k, 2.5 + 0.12 * (-1) ** k, 2.5 + 0.12 * (-1) ** k) for k in range(33)]
NECK = [(0.0, 0.0, z, radius, radius) for z, radius in ((0.0, 1.1), (14.0, 1.1), (37.0, 1.5), (44.0, 2.5))]
TINES = [
    (colour, (1.0, 0.0, 0.0), [(x, side * y, z, wide, thick) for x, y, z, wide, thick in stations])
    for side in (-1.0, 1.0)
    for colour, stations in (
        (STEEL, ((0.0, 2.0, 2.0, 0.7, 0.5), (0.0, 3.6, 22.0, 1.3, 0.8))),
        (INSULATION, (
            (0.0, 3.6, 22.0, 1.5, 1.0), (0.0, 5.1, 55.0, 2.2, 1.2), (-3.0, 5.4, 65.0, 2.6, 1.4),
            (-12.0, 5.7, 78.0, 3.0, 1.5), (-14.0, 5.7, 90.0, 4.0, 1.5), (-14.0, 2.0, 160.0, 4.0, 1.5),
        )),
    )
]  # fmt: skip
TUBE = [
    (0.0, 0.0, 2.0, 1.5, 1.5), (0.0, 0.0, 36.0, 1.5, 1.5), (-2.0, 0.0, 44.0, 1.5, 1.5), (-6.0, 0.0, 50.0, 1.5, 1.5),
    (-14.0, 0.0, 58.0, 1.7, 1.7), (-70.0, 0.0, 114.0, 1.7, 1.7),
]  # fmt: skip
PLATE = [
    (-7.0, 0.0, 53.0, 1.0, 0.5),
    (-9.0, 0.0, 55.0, 4.5, 0.8),
    (-17.0, 0.0, 63.0, 5.0, 0.8),
    (-21.0, 0.0, 67.0, 1.0, 0.5),
]
HOLE = [(-10.0, 0.0, 58.0, 0.8, 0.3), (-12.0, 0.0, 60.0, 1.2, 0.3), (-14.0, 0.0, 62.0, 0.8, 0.3)]
SHAPES = {
    "dissector": [(STEEL, (1.0, 0.0, 0.0), [*NECK, *RIBS, (0.0, 0.0, 140.0, 2.7, 2.7)])],
    "forceps": TINES,
    "suction": [(colour, (0.0, 1.0, 0.0), each) for colour, each in ((STEEL, TUBE), (STEEL, PLATE), (DARK, HOLE))],
}


def build_sweep(profile: np.ndarray, stations: np.ndarray, wide_axis: Sequence[float]) -> trimesh.Trimesh:
    """Sweep a profile along a smooth centre line; return a closed surface [m] whose sharp edges are shaded as sharp.

    Parameters
    ----------
    profile
        Points (k, 2) of a closed convex curve, counter-clockwise, along the wide axis and the normal.
    stations
        Rows (n, 5) along the centre line: a point [mm], and the scale factors [mm] of the profile along both axes.
    wide_axis
        Direction (3,) of the wide axis, not parallel to the centre line.
    """
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(stations[:, :3], axis=0), axis=1)))
    at = np.interp(np.arange(0.0, len(way) - 0.9, 1.0 / SECTIONS), np.arange(len(way)), way)
    rows = 1e-3 * PchipInterpolator(way, stations)(at)
    return build_loft(profile * rows[:, None, 3:], rows[:, :3], wide_axis)


def build_loft(profiles: np.ndarray, centre_line: np.ndarray, wide_axis: Sequence[float]) -> trimesh.Trimesh:
    """Join profiles (n, k, 2) [m] at the points (n, 3) [m] of a centre line to a closed surface; see `build_sweep`."""
    tangent = normalise_vectors(np.gradient(centre_line, axis=0))
    normal = normalise_vectors(np.cross(tangent, wide_axis))
    rings = centre_line[:, None] + profiles @ np.stack([np.cross(normal, tangent), normal], axis=1)
    count, around = rings.shape[:2]
    a, b = (around * np.arange(count - 1)[:, None] + np.roll(np.arange(around), -k) for k in (0, 1))
    fan = np.stack([np.zeros(around - 2, int), np.arange(1, around - 1), np.arange(2, around)], axis=1)
    sides = [np.stack(each, axis=-1).reshape(-1, 3) for each in ((a, b, b + around), (a, b + around, a + around))]
    faces = np.concatenate([*sides, fan[:, ::-1], fan + around * (count - 1)])
    return trimesh.graph.smooth_shade(trimesh.Trimesh(rings.reshape(-1, 3), faces, process=False), SHARP_ANGLE)


def has_instrument(tool: object) -> TypeGuard[Probe | Blade]:
    """Return True if a tool is drawn as an instrument: a ball or a blade of sufficient size, not another shape."""
    if type(tool) is Blade:
        return tool.length > 4.0 * tool.edge + 2.0 * SPATULA_BEND and tool.width > 4.0 * tool.edge
    return type(tool) is Probe and tool.radius >= MIN_BALL_RADIUS


@lru_cache(maxsize=8)
def build_instrument(tool: Probe | Blade, instrument: BallInstrument, segment_id: int) -> tuple[Layer, ...]:
    """Build the rendered layers of a brain spatula, or of an instrument with a ball, in tool coordinates."""
    if isinstance(tool, Blade):
        return (build_metal_layer([build_spatula(tool)], [STEEL], segment_id, BLADE_LIGHT),)
    lift = np.array([0.0, 0.0, 1e3 * tool.radius, 0.0, 0.0])
    meshes = [build_sweep(CIRCLE, stations + lift, wide) for _, wide, stations in SHAPES[instrument]]
    colours, (unit, triangles) = [colour for colour, *_ in SHAPES[instrument]], build_sphere(4)
    if instrument == "dissector":
        ball = trimesh.Trimesh(tool.radius * unit + 1e-3 * lift[:3], triangles)
        return (build_metal_layer([ball, *meshes], [STEEL, *colours], segment_id, STEEL_LIGHT),)
    # Fibres of wet cotton: deeper is darker.
    deep = np.random.default_rng(5).uniform(size=(len(unit), 1))
    at, colour = (tool.radius - FIBRE_DEPTH * deep) * unit + 1e-3 * lift[:3], np.array(COTTON) * (1.0 - 0.12 * deep)
    cotton = Layer("tool", segment_id, at, triangles, colour, gloss=0.15, shininess=20.0, casts_shadow=True)
    return cotton, build_metal_layer(meshes, colours, segment_id, STEEL_LIGHT)


def build_metal_layer(
    meshes: Sequence[trimesh.Trimesh], colours: Sequence[Sequence[float]], segment_id: int, gloss: tuple[float, float]
) -> Layer:
    """Join meshes, each with its colour, to one layer of polished metal; `gloss` contains gloss and shininess."""
    whole = cast(trimesh.Trimesh, trimesh.util.concatenate(meshes))
    along = np.asarray(whole.vertex_normals) @ REFLECTED
    bands = np.exp(-(((along[:, None] - BANDS) / 0.15) ** 2)).sum(axis=1, keepdims=True)
    colour = np.repeat(np.array(colours), [len(mesh.vertices) for mesh in meshes], axis=0) * (0.75 + 0.75 * bands)
    return Layer("tool", segment_id, whole.vertices, whole.faces, colour.clip(0.0, 1.0), *gloss, casts_shadow=True)


def build_spatula(blade: Blade) -> trimesh.Trimesh:
    """Build a brain spatula: the lower half of a blade, and a thinner strip that leads upwards from the blade's end."""
    edge, half = blade.edge, 0.5 * blade.length
    rounded = edge * np.sin(np.linspace(-0.48 * np.pi, 0.0, 9))
    y = np.append(rounded + edge - half, np.linspace(edge - half, half - SPATULA_BEND, 12)[1:])
    way = np.arange(SPATULA_STEP, 0.16, SPATULA_STEP)
    angle = np.interp(way, *SPATULA_ANGLES)
    thick = np.sqrt(edge**2 - np.minimum(y + half - edge, 0.0) ** 2)
    wide = np.append(0.5 * blade.width - edge + thick, np.interp(way, (0.0, 0.03), (0.5 * blade.width, 5e-3)))
    thick = np.append(thick, np.interp(way, (0.0, SPATULA_BEND), (edge, SPATULA_THICKNESS)))
    z = np.append(np.full(len(y), edge), edge + np.cumsum(SPATULA_STEP * np.sin(angle)))
    y = np.append(y, y[-1] + np.cumsum(SPATULA_STEP * np.cos(angle)))
    turn = np.linspace(np.pi, 2.0 * np.pi, 11)
    below = np.stack([np.cos(turn), np.sin(turn)], axis=1) * thick[:, None, None]
    below[..., 0] += np.sign(np.cos(turn).round(9)) * (wide - thick)[:, None]
    over = np.linspace(1.0, -1.0, 9)[1:-1]
    above = np.stack([wide[:, None] * over, -0.3 * thick[:, None] * (1.0 - over**2)], axis=2)
    return build_loft(np.concatenate([below, above], axis=1), np.stack([0.0 * y, y, z], axis=1), (-1.0, 0.0, 0.0))
