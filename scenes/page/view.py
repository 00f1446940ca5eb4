"""3-D view of a page: surfaces, orientation labels, and camera."""

import numpy as np

from ar.overlay.hud import draw_orientation_labels
from ar.page.browser import Browser
from ar.page.parts import SceneImage, SceneLabel, SceneSurface, SceneViewpoint
from ar.page.slices import HALF_VIEW, OUTSIDE_GREY, PLANES, VIEW_SIDE, resample_view

from ..play.drape import cut_hole
from ..play.observer import ELLIPSOID_COLOUR, SPHERE, SPHERE_FACES
from ..play.player import Frame, Player
from ..play.stage import TOOL_COLOUR, TRUTH_COLOUR, TUMOUR_COLOUR, Stage
from ..script.craniotomy_frame import CraniotomyFrame
from ..script.framing import DRAPE_HEIGHT
from .fem_worker import FemResult

FEM_COLOUR = TRUTH_COLOUR  # Colour of the FEM tumour.
STALE_COLOUR = (0.45, 0.45, 0.45)
"""Colour of the FEM tumour while its load differs from the shown one."""
BRAIN_COLOUR = (0.50, 0.38, 0.36)  # Colour of the inside of the brain's far side: its near side would hide the rest.
CORTEX_COLOURS = {"cortex": (0.80, 0.53, 0.47), "sulci": (0.45, 0.15, 0.16)}  # Colours of crowns and sulci.
EDGE_COLOUR, EDGE_WIDTH = (0.93, 0.86, 0.72), 2.5e-3
"""Colour and width [m] of the ring of bone round the craniotomy."""
SCAN_COLOUR = (0.96, 0.96, 0.92)  # Colour of the tumour in the scan.
INITIAL_RADIUS = 1e-4  # Radius of the ellipsoid before there is one [m].
LETTER_DISTANCE = 12e-3  # Distance of the orientation letters from the brain [m].


def build_page_bodies(stage: Stage) -> list[SceneSurface]:
    """Build surfaces of the 3-D view: undeformed brain, cortex, tumour and FEM tumour; ellipsoid and tool if any."""
    tool, site, tumour = stage.scene.tool, stage.site, stage.build_tumour(stage.site.anatomy.mesh.nodes)
    wire = SceneSurface("finite elements", tumour.vertices, tumour.triangles, STALE_COLOUR, wireframe=True)
    bodies = [*build_brain(stage), wire]
    if stage.observer is not None:
        centre = tumour.vertices.mean(axis=0)
        bodies.append(
            SceneSurface("ellipsoid", centre + INITIAL_RADIUS * SPHERE, SPHERE_FACES, ELLIPSOID_COLOUR, wireframe=True)
        )
    if tool is not None:
        pose = tool.pose(site.origin - 0.02 * site.axis, site.axis, site.right)
        vertices = tool.mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
        bodies.append(SceneSurface("tool", vertices, tool.mesh.faces, TOOL_COLOUR))
    return bodies


def build_brain(stage: Stage) -> list[SceneSurface]:
    """Build the surfaces of the undeformed brain, open cortex and tumour, and of the craniotomy edge."""
    brain, scan, cortex = stage.brain_surface, stage.tumour_at_rest, split_cortex(stage, stage.site.anatomy.mesh.nodes)
    return [
        SceneSurface("brain", brain.vertices, brain.triangles, BRAIN_COLOUR, side="back"),
        *(SceneSurface(*part, CORTEX_COLOURS[part[0]]) for part in cortex),
        build_craniotomy_edge(stage),
        SceneSurface("scan", scan.vertices, scan.triangles, SCAN_COLOUR, side="back", meaning="tumour in the scan"),
        SceneSurface("tumour", scan.vertices, scan.triangles, TUMOUR_COLOUR, meaning="tumour now"),
    ]


def split_cortex(stage: Stage, positions: np.ndarray) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Split the open cortex at `positions` (V, 3) [m] into crowns and sulci: names, vertices, triangles of both."""
    points = stage.coarse_gyri.surface.compute_vertices(positions[stage.coarse_gyri.vertices])
    return [(name, points[used], faces) for name, (used, faces) in zip(CORTEX_COLOURS, stage.gyri_parts, strict=True)]


def build_craniotomy_edge(stage: Stage) -> SceneSurface:
    """Build the surface of a ring of bone round the craniotomy."""
    site, (points, _, edge) = stage.site, cut_hole(stage.site)
    inner = points[edge] + DRAPE_HEIGHT * site.axis
    outward = inner - site.origin
    outward -= (outward @ site.axis)[..., None] * site.axis
    outer = inner + EDGE_WIDTH * outward / np.linalg.norm(outward, axis=2, keepdims=True)
    corners = 4 * np.arange(len(edge))[:, None, None] + np.array([[0, 1, 3], [0, 3, 2]])
    vertices, triangles = np.concatenate([inner, outer], axis=1).reshape(-1, 3), corners.reshape(-1, 3)
    return SceneSurface("edge", vertices, triangles, EDGE_COLOUR, meaning="edge of the craniotomy")


def build_static_bodies(stage: Stage) -> list[SceneLabel | SceneImage]:
    """Build static objects of the 3-D view: orientation letters round the brain, and scan planes behind the tumour."""
    surroundings: list[SceneLabel | SceneImage] = [*list_orientation_labels(stage.site)]
    scan, centre = stage.head_scan_texture, stage.tumour_at_rest.vertices.mean(axis=0)
    for plane in PLANES if scan is not None else ():
        assert scan is not None
        grey = resample_view(plane, scan, centre)
        behind = (plane.compute_points(centre, VIEW_SIDE) - centre) @ stage.site.axis > 0.0
        colour = np.stack([grey, grey, grey, 255 * (behind & (grey != OUTSIDE_GREY)).astype(np.uint8)], axis=2)
        edges = (2.0 * HALF_VIEW * np.array(edge) for edge in (plane.right, plane.down))
        surroundings.append(SceneImage(plane.name, colour, centre, *edges))
    return surroundings


def list_orientation_labels(site: CraniotomyFrame) -> list[SceneLabel]:
    """Return the orientation letters (R, L, A, P, S, I) around the brain."""
    nodes = site.anatomy.mesh.nodes
    centre, half_size = 0.5 * (nodes.min(axis=0) + nodes.max(axis=0)), 0.5 * np.ptp(nodes, axis=0) + LETTER_DISTANCE
    offsets = np.kron(np.diag(half_size), [[1.0], [-1.0]])
    return [SceneLabel(letter, centre + offset) for letter, offset in zip("RLAPSI", offsets, strict=True)]


def choose_viewpoint(site: CraniotomyFrame) -> SceneViewpoint:
    """Return an oblique viewpoint towards the open cortex."""
    eye = site.origin - 0.10 * site.axis + 0.13 * site.right + 0.05 * site.up
    return SceneViewpoint(eye, site.origin + 0.02 * site.axis - 0.01 * site.right, site.up, fov=np.radians(38.0))


def move_bodies(browser: Browser, frame: Frame, player: Player) -> None:
    """Move cortex, tumour, ellipsoid and tool of the 3-D view to their positions in a frame."""
    positions, tool = player.estimate_positions(frame), player.scene.tool
    stage = player.stage.select_stage(frame.loads)
    tumour = stage.build_tumour(positions)
    for name, vertices, triangles in (*split_cortex(stage, positions), ("tumour", tumour.vertices, tumour.triangles)):
        browser.move(name, vertices, triangles)
    ellipsoid = None if frame.estimate is None else frame.estimate.build_ellipsoid()
    if ellipsoid is not None:
        browser.move(ellipsoid.name, ellipsoid.vertices)
    if tool is not None and frame.pose is not None:
        browser.move("tool", tool.mesh.vertices @ frame.pose[:3, :3].T + frame.pose[:3, 3])


def move_fem_tumour(browser: Browser, stage: Stage, fem_result: FemResult, player: Player) -> None:
    """Move the FEM tumour of the 3-D view to its position in an FEM solution."""
    tumour = stage.select_stage(fem_result.loads).build_tumour(player.compute_positions(fem_result.deformation))
    browser.move("finite elements", tumour.vertices, tumour.triangles)


def render_page_image(frame: Frame) -> np.ndarray:
    """Return a frame's image (H, W, 3) uint8 with orientation letters."""
    return draw_orientation_labels(frame.shown, frame.camera.T_camera_world[:3, :3], frame.taken)
