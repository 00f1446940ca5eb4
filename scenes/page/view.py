"""3-D view of a page: surfaces, orientation labels, and camera."""

from __future__ import annotations

import numpy as np

from ar.overlay.hud import draw_orientation_labels
from ar.page.browser import Browser
from ar.page.parts import SceneSurface, SceneViewpoint, Sign

from ..play.observer import ELLIPSOID_COLOUR, SPHERE, SPHERE_FACES
from ..play.player import Frame, Player
from ..play.stage import CORTEX_COLOUR, TOOL_COLOUR, TRUTH_COLOUR, TUMOUR_COLOUR, Stage
from ..script.craniotomy_frame import CraniotomyFrame
from .fem_worker import FemResult

FEM_COLOUR = TRUTH_COLOUR  # Colour of the FEM tumour.
STALE_COLOUR = (0.45, 0.45, 0.45)
"""Colour of the FEM tumour while it belongs to another load than the one shown."""
INITIAL_RADIUS = 1e-4  # Radius of the ellipsoid before there is one [m].
LETTER_DISTANCE = 12e-3  # Distance of the orientation letters from the brain [m].


def build_page_bodies(stage: Stage) -> list[SceneSurface]:
    """Brain, open cortex, tumour, the finite elements' tumour, an estimate's ellipsoid and the tool, at rest."""
    tool, site, tumour = stage.scene.tool, stage.site, stage.build_tumour(stage.site.anatomy.mesh.nodes)
    wire = SceneSurface("finite elements", tumour.vertices, tumour.triangles, STALE_COLOUR, wireframe=True)
    bodies = [*build_brain(stage), wire]
    if stage.observer is not None:
        middle = tumour.vertices.mean(axis=0)
        bodies.append(
            SceneSurface("ellipsoid", middle + INITIAL_RADIUS * SPHERE, SPHERE_FACES, ELLIPSOID_COLOUR, wireframe=True)
        )
    if tool is not None:
        pose = tool.pose(site.origin - 0.02 * site.axis, site.axis, site.right)
        at = tool.mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
        bodies.append(SceneSurface("tool", at, tool.mesh.faces, TOOL_COLOUR))
    return bodies


def build_brain(stage: Stage) -> list[SceneSurface]:
    """Brain, open cortex and tumour, at rest."""
    positions = stage.site.anatomy.mesh.nodes
    brain, cortex, tumour = stage.brain, stage.build_cortex(positions), stage.build_tumour(positions)
    return [
        SceneSurface("brain", brain.vertices, brain.triangles, (0.80, 0.62, 0.58), opacity=0.25),
        SceneSurface("cortex", cortex.vertices, cortex.triangles, CORTEX_COLOUR, opacity=0.4),
        SceneSurface("tumour", tumour.vertices, tumour.triangles, TUMOUR_COLOUR),
    ]


def list_orientation_labels(site: CraniotomyFrame) -> list[Sign]:
    """Return the patient's sides round the brain."""
    nodes = site.anatomy.mesh.nodes
    middle, half = 0.5 * (nodes.min(axis=0) + nodes.max(axis=0)), 0.5 * np.ptp(nodes, axis=0) + LETTER_DISTANCE
    ways = zip(("RL", "AP", "SI"), np.diag(half), strict=True)
    return [Sign(word, middle + way) for (plus, minus), arm in ways for word, way in ((plus, arm), (minus, -arm))]


def choose_viewpoint(site: CraniotomyFrame) -> SceneViewpoint:
    """Obliquely onto the open cortex."""
    eye = site.origin - 0.10 * site.axis + 0.13 * site.right + 0.05 * site.up
    return SceneViewpoint(eye, site.origin + 0.03 * site.axis - 0.01 * site.right, site.up, fov=np.radians(44.0))


def move_bodies(browser: Browser, frame: Frame, player: Player) -> None:
    """Put the bodies of the 3-D view where a frame has them."""
    positions, tool = player.estimate_positions(frame), player.scene.tool
    stage = player.stage.select_stage(frame.loads)
    for layer in (stage.build_cortex(positions), stage.build_tumour(positions)):
        browser.move(layer.name, layer.vertices, layer.triangles)
    ellipsoid = None if frame.estimate is None else frame.estimate.build_ellipsoid()
    if ellipsoid is not None:
        browser.move(ellipsoid.name, ellipsoid.vertices)
    if tool is not None and frame.pose is not None:
        browser.move("tool", tool.mesh.vertices @ frame.pose[:3, :3].T + frame.pose[:3, 3])


def move_wire(browser: Browser, stage: Stage, truth: FemResult, player: Player) -> None:
    """Show where the finite elements, under all effects, have the tumour."""
    seen = stage.select_stage(truth.loads).build_tumour(player.compute_positions(truth.deformation))
    browser.move("finite elements", seen.vertices, seen.triangles)


def render_page_image(frame: Frame) -> np.ndarray:
    """Return a frame's image (H, W, 3) uint8 with the orientation letters."""
    return draw_orientation_labels(frame.shown, frame.camera.T_camera_world[:3, :3], frame.taken)
