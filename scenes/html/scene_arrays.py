"""Surfaces, colours, light and camera of a scene, as arrays and JSON for its page."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.interpolate import griddata
from scipy.ndimage import map_coordinates

from ar.optics.camera import Camera
from ar.overlay.composite import DOUBTFUL_COLOUR
from ar.overlay.marks import BEFORE_COLOUR
from ar.rendering.layer import Layer
from ar.rendering.renderer import DRAPE_COLOUR
from sim.errors import InputError
from surrogate.data.cortex_patch import open_patch

from ..play.player import BLOCKED_DEPTH, CARRIED_DEPTH
from ..play.stage import RIM_DISTANCE, TUMOUR_COLOUR, Stage
from ..script.tool import Probe
from ..script.tool_paths import IDLE_HEIGHT, MIN_VISIBLE_FORCE

NO_ROW = 0xFFFF  # Number of a vertex that the model does not predict.
TEXTURE_SIDE = 192  # Side of the texture of the cortex [pixel].
MAX_SLOPE = 600.0  # Largest slope of the grey values in the texture [1/m].
NEAR, FAR = 0.2, 2.0  # Smallest and largest drawn depth, relative to the distance from the camera to the cortex.


def build_arrays(stage: Stage, nodes: np.ndarray) -> dict[str, np.ndarray]:
    """Build the arrays of a page, by name, for a model that predicts displacements of the vertices `nodes` (n,).

    Raises
    ------
    InputError
        The mesh has more points than 16-bit numbers can index.
    """
    anatomy, rest, tool = stage.anatomy, stage.anatomy.mesh.nodes, stage.scene.tool
    assert isinstance(tool, Probe)
    if len(rest) >= NO_ROW:
        raise InputError(f"the mesh has {len(rest)} points, but a page draws at most {NO_ROW - 1}: use a coarser mesh.")
    cortex, drape = stage.build_layers(rest, None)
    patch = open_patch(anatomy)
    pose = tool.pose(np.zeros(3), stage.site.axis, stage.site.right)
    used, drape_triangles = np.unique(drape.triangles, return_inverse=True)
    arrays = {
        **_build_surface("patch", patch.points, patch.triangles, np.float64),
        "patchRows": find_row_indices(patch.nodes, nodes),
        **_build_surface("cortex", cortex.vertices, cortex.triangles),
        "cortexRows": find_row_indices(stage.visible_vertices, nodes),
        **_build_surface("drape", drape.vertices[used], drape_triangles),
        **_build_surface("tool", tool.mesh.vertices @ pose[:3, :3].T + pose[:3, 3], tool.mesh.faces),
        **_build_surface("tumour", rest[stage.tumour_vertices], stage.tumour_at_rest.triangles),
        "tumourRows": find_row_indices(stage.tumour_vertices, nodes),
    }
    return arrays | _build_texture(stage, cortex)


def find_row_indices(vertices: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return the index (n,) uint16 of each of the `vertices` (n,) in sorted `nodes`, or `NO_ROW` if absent."""
    row = np.searchsorted(nodes, vertices).clip(max=len(nodes) - 1)
    return np.where(nodes[row] == vertices, row, NO_ROW).astype(np.uint16)


def _build_surface(name: str, points: np.ndarray, triangles: np.ndarray, dtype: type = np.float32) -> dict:
    return {name: np.asarray(points).astype(dtype), f"{name}Triangles": np.asarray(triangles).astype(np.uint16)}


def _build_texture(stage: Stage, cortex: Layer) -> dict[str, np.ndarray]:
    """Build the texture of the scan over the tangent plane, and the texture coordinates of the cortex vertices."""
    if cortex.solid is None or cortex.rest is None:
        return {}
    site, half = stage.site, stage.site.radius + RIM_DISTANCE
    flat = np.stack([(cortex.rest - site.origin) @ each for each in (site.right, site.up, site.axis)], axis=1)
    across = half * (2.0 * (np.arange(TEXTURE_SIDE) + 0.5) / TEXTURE_SIDE - 1.0)
    x, y = np.meshgrid(across, across)
    depth = griddata(flat[:, :2], flat[:, 2], (x, y), method="linear")
    depth = np.where(np.isnan(depth), griddata(flat[:, :2], flat[:, 2], (x, y), method="nearest"), depth)
    world = site.origin + x[..., None] * site.right + y[..., None] * site.up + depth[..., None] * site.axis
    T = cortex.solid.T_index_world
    index = np.moveaxis(world @ T[:3, :3].T + T[:3, 3], -1, 0)
    values = map_coordinates(np.asarray(cortex.solid.values), index, order=1, mode="nearest")
    up, right = (slope / (2.0 * half / TEXTURE_SIDE) / (2.0 * MAX_SLOPE) + 0.5 for slope in np.gradient(values))
    return {
        "texels": (0.5 + 0.5 * flat[:, :2] / half).astype(np.float32),
        "scan": np.rint(255.0 * np.stack([values, right, up], axis=-1).clip(0.0, 1.0)).astype(np.uint8),
    }


def describe_camera_and_tool(stage: Stage, camera: Camera) -> dict[str, Any]:
    """Describe coordinate system, camera, light, colours and tool for JSON; lengths [m], linear colours."""
    site, tool, lamp, scene = stage.site, stage.scene.tool, stage.lamp, stage.scene
    assert isinstance(tool, Probe)
    axis, pose = lamp.target - lamp.position, tool.pose(np.zeros(3), site.axis, site.right)
    angle = np.arctan(lamp.radius / np.linalg.norm(axis))
    distance = float(camera.to_camera_frame(site.origin)[2])
    frame = {name: getattr(site, name).tolist() for name in ("origin", "axis", "right", "up")}
    return {
        "frame": {**frame, "reach": site.compute_reach(tool.radius)},
        "camera": {
            "T": camera.T_camera_world[:3].tolist(), "focal": camera.K[0, 0], "centre": camera.K[:2, 2].tolist(),
            "width": camera.width, "height": camera.height, "near": NEAR * distance, "far": FAR * distance,
        },
        "light": {
            "eye": camera.centre.tolist(), "lamp": lamp.position.tolist(),
            "lampAxis": (axis / np.linalg.norm(axis)).tolist(),
            "cone": [np.cos(angle), 1.0 / (np.cos(0.55 * angle) - np.cos(angle))],
            "light": [lamp.strength, lamp.ambient], "right": frame["right"], "up": frame["up"],
        },
        "looks": _describe_layers(stage, pose),
        "background": (0.25 * np.array(DRAPE_COLOUR)).tolist(),
        "inks": {"tumour": TUMOUR_COLOUR, "doubtful": DOUBTFUL_COLOUR, "scan": BEFORE_COLOUR},
        # Direction of the shaft; radii of ball, shaft and grip, and distance from ball to grip.
        "tool": {
            "radius": tool.radius, "rod": pose[:3, 2].tolist(), "radii": [tool.radius, tool.shaft, *tool.grip],
        },
        "force": {
            "lift": IDLE_HEIGHT, "visible": MIN_VISIBLE_FORCE, "carried": CARRIED_DEPTH, "blocked": BLOCKED_DEPTH,
            "start": max(scene.path(float(time)).force for time in scene.times),
        },
    }  # fmt: skip


def _describe_layers(stage: Stage, pose: np.ndarray) -> Mapping[str, Any]:
    """Describe colour, highlight and relief of the drawn layers, by name, with the tool at a pose (4, 4)."""
    looks = {}
    for layer in stage.build_layers(stage.anatomy.mesh.nodes, pose):
        looks[layer.name] = {
            "base": np.square(layer.colour[0]).tolist(), "shine": [layer.gloss, layer.shininess], "relief": 0.0,
            "dark": [0.0] * 3,
        }  # fmt: skip
        if layer.solid is not None:
            looks[layer.name] |= {"dark": layer.solid.dark, "relief": 2.0 * MAX_SLOPE * layer.solid.relief}
    return looks
