"""Rendered parts of a scene: open cortex, drape with a hole, tool, and the hidden tumour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from ar.optics.camera import Camera
from ar.overlay.legend import LegendNames
from ar.overlay.styles import Opening
from ar.rendering.camera_effects import add_camera_effects
from ar.rendering.embedding import EmbeddedSurface, build_embedded_surface
from ar.rendering.layer import Layer, Solid, compute_vertex_normals
from ar.rendering.real_image import add_vignette, scale_image
from ar.rendering.renderer import Lamp, Picture, Renderer, build_lamp
from sim.anatomy import Anatomy
from sim.bodies.intensity import Intensity
from sim.discretisation.resected_body import RemainingBody, list_remaining_bodies
from sim.effects import SkullContact
from sim.loads import Loads, Resected

from ..script.craniotomy_frame import HOLE_RATIO, CraniotomyFrame
from ..script.observation_models import StereoObservation
from ..script.scene import Scene
from .cortex_layers import COTTON, GLOVE, CottonoidSurface, add_vessels, build_cottonoids, build_finger
from .drape import DRAPE_DEPTH, build_drape
from .fine_cortex import FineCortex, build_fine_cortex
from .instruments import build_instrument, has_instrument
from .observer import TumourObserver

CORTEX, DRAPE, TOOL, TUMOUR = 1, 2, 3, 4
"""Segmentation ids."""
NAMES = {CORTEX: "cortex", DRAPE: "drape", TOOL: "tool", COTTON: "cotton", GLOVE: "glove"}
"""Names of the visible layers (the tumour is never visible)."""

CORTEX_COLOUR = (0.86, 0.60, 0.54)  # Colour of the cortex (RGB, 0 to 1).
TOOL_COLOUR = (0.78, 0.80, 0.83)  # Colour of the tool (RGB, 0 to 1).
# Line colours that colour-blind users can distinguish, on cortex and drape: tests/test_scenes_checks.py.
TUMOUR_COLOUR = (0.20, 0.94, 0.42)
TRUTH_COLOUR = (0.90, 0.35, 0.78)
"""Colour of the tumour surface computed by FEM."""
DARK_SHARES = (0.33, 0.16, 0.17)  # Share of the cortex colour (RGB) that the scan's black keeps.
RELIEF_DEPTH = 1.5e-3  # Depth of black below white [m].
OPENING = Opening((CORTEX,), ((DRAPE, "under the drape"),), "seen through bone")
"""Layer under which the tumour is drawn as visible (cortex), and text for the occluding layers."""
SIMULATED = "simulated (FEM)"  # Name of the line of the tumour computed by FEM.
# Names of the lines in an image of a prediction.
PREDICTED_LINES = LegendNames("predicted tumour", "95 % error band", "in the scan")
ESTIMATED_LINES = LegendNames(
    "estimated tumour", "", "in the scan", ("95 % of its centre", SIMULATED), "estimate moved"
)
"""Names of the lines in an image of an estimate."""
# Depth under the surface at which the scan is read [m]: the edge of grey matter mixes with fluid.
READING_DEPTH = 2.0e-3
# Largest distance from the craniotomy edge, under the bone, at which the cortex may become visible [m].
RIM_DISTANCE = 10e-3
TUMOUR_DEPTH = 0.03e-3  # Depth of the tumour's outline below rounded facets [m]: it cuts off mesh corners.
TUMOUR_HEIGHT = 0.06e-3  # Largest height of the outline above the facets [m]: coarse meshes stay recognisable.
DARK_SHARE = 0.6  # Brightness of a sulcus as a share of the brightest crown.
RELIEF_EDGE = 1.0e-3  # Largest edge of the cortex of `relief` [m].
TUMOUR_EDGE = 1.8e-3  # Largest edge of the tumour's surface where its outline is drawn [m].
DRAPE_SLOPE = 3.0  # Slope of the drape beyond the hole, down to the depth of the drape's wall.


@dataclass(frozen=True, eq=False)
class CortexSurface:
    """Part of the FEM surface: mesh vertices (n,), triangles (m, 3), scan, and points (n, 3) [m] to sample the scan."""

    vertices: np.ndarray
    triangles: np.ndarray
    rest_points: np.ndarray
    texture: Solid | None
    colour: np.ndarray | tuple[float, float, float] = CORTEX_COLOUR

    def build_layer(self, positions: np.ndarray) -> Layer:
        """Build the layer to render for mesh vertices at `positions` (V, 3) [m]."""
        rest = None if self.texture is None else self.rest_points
        return Layer(
            "cortex", CORTEX, positions[self.vertices], self.triangles, self.colour, 0.5, solid=self.texture, rest=rest
        )


@dataclass(frozen=True, eq=False)
class Stage:
    """Rendered parts of a scene on an anatomy. All `positions` (V, 3) [m] are positions of all mesh vertices.

    `device`: Warp device for rendering. `observer`: observer of a scene with an observation model; else None.
    """

    scene: Scene
    site: CraniotomyFrame
    intensity: Intensity | None = None
    remaining_body: RemainingBody | None = None
    device: str = "cpu"
    observer: TumourObserver | None = None

    @property
    def anatomy(self) -> Anatomy:
        """Anatomy, without resected tissue."""
        return self.site.anatomy if self.remaining_body is None else self.remaining_body.anatomy

    def select_stage(self, loads: Loads) -> Stage:
        """Return the stage after the resection steps that are completed in the first load case."""
        cause = loads.get(Resected)
        return self if cause is None else self._after[int(cause.done[0])]

    @cached_property
    def _after(self) -> tuple[Stage, ...]:
        """Stages after 0, 1, ... resection steps."""
        whole = self.site.anatomy
        return tuple(
            replace(self, remaining_body=left)
            for left in list_remaining_bodies(whole, self.scene.get_effects_on(whole))
        )

    @cached_property
    def without_fine_cortex(self) -> Stage:
        """Copy of the stage that renders the FEM surface as the cortex, without gyri and vessels."""
        return replace(self, scene=replace(self.scene, look=replace(self.scene.look, natural=False)))

    @cached_property
    def drawn_vertices(self) -> np.ndarray:
        """Sorted mesh vertices (n,) whose motion is rendered: open cortex and tumour."""
        anatomy = self.anatomy
        return np.union1d(np.unique(anatomy.open_surface), anatomy.tumour_nodes)

    @cached_property
    def camera(self) -> Camera:
        """Initial camera of the scene. A static camera is always this object: a `Renderer` caches its background."""
        return self.scene.viewpoint.build_camera(self.site)

    @cached_property
    def lamp(self) -> Lamp:
        """Lamp over the surgeon's shoulder."""
        site, look = self.site, self.scene.look
        lamp = build_lamp(self.camera, site.origin, radius=1.6 * site.radius)
        turned = Rotation.from_rotvec(look.turn * site.axis).apply(lamp.position - site.origin)
        return replace(lamp, position=site.origin + turned, strength=look.lamp, ambient=look.ambient)

    def build_visible_cortex(self, positions: np.ndarray) -> Layer:
        """Build the layer of the open cortex and of the cortex near the bone's edge, which brain shift may expose.

        If the brain can separate from the skull, the surface outside the drape's hole is rendered deeper, so that a
        sliding gyrus does not penetrate the drape, which follows the undeformed surface.
        """
        layer = self._build_fine(positions) if self.scene.look.natural else self._visible.build_layer(positions)
        if not any(isinstance(effect, SkullContact) for effect in self.scene.effects):
            return layer
        beyond = self.site.compute_axis_distance(layer.vertices) - HOLE_RATIO * self.site.clearance
        below = np.minimum(DRAPE_SLOPE * beyond.clip(0.0), DRAPE_DEPTH)
        return replace(layer, vertices=layer.vertices + below[:, None] * self.site.axis)

    def _build_fine(self, positions: np.ndarray) -> Layer:
        fine, tint = self.fine_cortex, self.scene.look.tint
        at = fine.surface.compute_vertices(positions[fine.vertices])
        return Layer("cortex", CORTEX, at, fine.surface.triangles, fine.colour * tint, gloss=0.7, shininess=110.0)

    @cached_property
    def coarse_gyri(self) -> FineCortex:
        """Open cortex inside the drape's hole, with coarse gyri."""
        mesh, site = self.anatomy.mesh, self.site
        fine = build_fine_cortex(site, mesh, self.anatomy.open_surface, self.intensity, RELIEF_EDGE)
        away = site.compute_axis_distance(fine.surface.interpolate(mesh.nodes[fine.vertices]))
        seen = (away < HOLE_RATIO * site.clearance)[fine.surface.triangles].any(axis=1)
        return replace(fine, surface=replace(fine.surface, triangles=fine.surface.triangles[seen]))

    @cached_property
    def gyri_parts(self) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
        """Bright crowns and dark sulci of `coarse_gyri`: vertices (n,) of each part, and its triangles (m, 3)."""
        triangles, colour = self.coarse_gyri.surface.triangles, self.coarse_gyri.colour
        dark = colour[triangles].mean(axis=(1, 2)) < DARK_SHARE * colour.mean(axis=1).max()
        crowns, sulci = (np.unique(triangles[some], return_inverse=True) for some in (~dark, dark))
        return crowns, sulci

    @cached_property
    def brain_surface(self) -> Layer:
        """Layer of the undeformed brain surface without the open cortex."""
        mesh, craniotomy = self.anatomy.mesh, self.anatomy.craniotomy
        vertices, triangles = np.unique(mesh.surface[~craniotomy[mesh.surface].all(axis=1)], return_inverse=True)
        return Layer("brain", CORTEX, mesh.nodes[vertices], triangles, CORTEX_COLOUR)

    def build_layers(self, positions: np.ndarray, pose: np.ndarray | None) -> list[Layer]:
        """Build layers of cortex at `positions` (V, 3) [m], drape, and tool at T_world_tool `pose` (4, 4) if any."""
        tool, look = self.scene.tool, self.scene.look
        if pose is None or not look.natural or not has_instrument(tool):
            return self._list_layers(positions, self.compute_tool_corners(pose))
        parts = build_instrument(tool, look.instrument, TOOL)
        placed = (replace(part, vertices=part.vertices @ pose[:3, :3].T + pose[:3, 3]) for part in parts)
        return [*self._list_layers(positions, None), *placed]

    def compute_tool_corners(self, pose: np.ndarray | None) -> np.ndarray | None:
        """Compute the tool's surface corners (t, 3) [m] at T_world_tool `pose` (4, 4); None without tool or pose."""
        if self.scene.tool is None or pose is None:
            return None
        return np.asarray(self.scene.tool.mesh.vertices) @ pose[:3, :3].T + pose[:3, 3]

    def _list_layers(self, positions: np.ndarray, corners: np.ndarray | None) -> list[Layer]:
        look = self.scene.look
        seen = [self.build_visible_cortex(positions), self._drape]
        seen += [] if look.finger is None else [self._finger]
        seen += [self._squares.build_layer(positions)] if look.cottonoids else []
        if self.scene.tool is None or corners is None:
            return seen
        faces = self.scene.tool.mesh.faces
        return [*seen, Layer("tool", TOOL, corners, faces, TOOL_COLOUR, gloss=0.8, shininess=90.0, casts_shadow=True)]

    def render(self, camera: Camera, positions: np.ndarray, pose: np.ndarray | None) -> Picture:
        """Render the layers of `build_layers` with a camera."""
        return self._draw(camera, self.build_layers(positions, pose))

    def render_view(
        self, camera: Camera, positions: np.ndarray, pose: np.ndarray | None, is_coarse: bool, frame_number: int = 0
    ) -> Picture:
        """Render frame `frame_number` with blur and noise, and with the round field of view of a microscope if any.

        If `is_coarse`, the image is rendered with half the resolution and enlarged.
        """
        seen_by, look = _halve_resolution(camera) if is_coarse else camera, self.scene.look
        picture = self.render(seen_by, positions, pose)
        picture = add_camera_effects(picture, seen_by, self.site.origin, look.aperture, look.noise, frame_number)
        if self.scene.viewpoint.field is not None:
            picture = add_vignette(picture, self.scene.viewpoint.field)
        return scale_image(picture, camera.width, camera.height) if is_coarse else picture

    def render_with_corners(self, camera: Camera, positions: np.ndarray, corners: np.ndarray | None) -> Picture:
        """Render the layers with a tool given by its surface corners (t, 3) [m]; None: without tool."""
        return self._draw(camera, self._list_layers(positions, corners))

    def _draw(self, camera: Camera, layers: Sequence[Layer]) -> Picture:
        counts = tuple(len(layer.triangles) for layer in layers)
        if counts not in self._renderers:
            self._renderers[counts] = Renderer(layers, self.lamp, self.device)
        return self._renderers[counts].render(camera, [layer.vertices for layer in layers if not layer.still])

    @cached_property
    def _squares(self) -> CottonoidSurface:
        return build_cottonoids(self.site, self.scene.look.cottonoids)

    @cached_property
    def _finger(self) -> Layer:
        return build_finger(self.site, self.scene.look.finger or 0.0)

    @cached_property
    def _renderers(self) -> dict[tuple[int, ...], Renderer]:
        """Cached renderers, by the triangle counts of the layers (with and without tool)."""
        return {}

    def build_tumour(self, positions: np.ndarray) -> Layer:
        """Return the layer of the tumour's surface for mesh vertices at `positions` (V, 3) [m]."""
        vertices, triangles = self._tumour
        return Layer("tumour", TUMOUR, positions[vertices], triangles, TUMOUR_COLOUR)

    def smooth_tumour(self, tumour: Layer) -> Layer:
        """Return a tumour layer with rounded facets, to draw the outline; measurements use the original surface."""
        surface = self.rounded_tumour
        return replace(
            tumour,
            vertices=surface.compute_vertices(tumour.vertices),
            triangles=surface.triangles,
            colour=tumour.colour[0],
        )

    def build_fem_tumour(self, positions: np.ndarray) -> Layer:
        """Return the layer of the tumour surface computed by FEM, drawn for comparison with an estimate."""
        return replace(self.build_tumour(positions), name="truth", colour=np.array(TRUTH_COLOUR))

    @cached_property
    def tumour_at_rest(self) -> Layer:
        """Layer of the tumour's undeformed surface."""
        return self.build_tumour(self.site.anatomy.mesh.nodes)

    @cached_property
    def smooth_tumour_at_rest(self) -> Layer:
        """Layer of the tumour's undeformed surface, with rounded facets."""
        return self.smooth_tumour(self.tumour_at_rest)

    @property
    def tumour_vertices(self) -> np.ndarray:
        """Mesh vertices (n,) of the tumour's surface, in the vertex order of the layer."""
        return self._tumour[0]

    @property
    def visible_vertices(self) -> np.ndarray:
        """Mesh vertices (n,) of the visible FEM surface, in the vertex order of its layer."""
        return self._visible.vertices

    @cached_property
    def _tumour(self) -> tuple[np.ndarray, np.ndarray]:
        return np.unique(self.anatomy.tumour_surface, return_inverse=True)

    @cached_property
    def rounded_tumour(self) -> EmbeddedSurface:
        """Fine surface with rounded facets, embedded in the tumour's surface."""
        at, triangles = self.site.anatomy.mesh.nodes[self._tumour[0]], self._tumour[1]
        fine = build_embedded_surface(at, triangles, lambda points: np.full(len(points), TUMOUR_EDGE))
        return replace(fine, depth=np.full_like(fine.depth, TUMOUR_DEPTH), rounding=0.5, max_height=TUMOUR_HEIGHT)

    @cached_property
    def _visible(self) -> CortexSurface:
        vertices, triangles = np.unique(_list_visible(self.site, self.anatomy), return_inverse=True)
        at = self.anatomy.mesh.nodes[vertices]
        colour = np.array(CORTEX_COLOUR) * self.scene.look.tint
        return CortexSurface(
            vertices, triangles, at - READING_DEPTH * compute_vertex_normals(at, triangles), self.scan_texture, colour
        )

    @cached_property
    def fine_cortex(self) -> FineCortex:
        """Fine surface with gyri and vessels, embedded in the visible FEM surface."""
        if self.remaining_body is None:
            return _build_whole_cortex(self.site, self.intensity)
        return build_fine_cortex(self.site, self.anatomy.mesh, _list_visible(self.site, self.anatomy), self.intensity)

    @cached_property
    def scan_texture(self) -> Solid | None:
        """Solid texture of the scan with the vessels of the scene; None without scan and without vessels."""
        model, seed = self.scene.observation_model, self.scene.look.vessels
        if isinstance(model, StereoObservation) and model.vessels:
            seed = model.seed
        if seed is not None:
            return add_vessels(self.intensity, self.site, seed, DARK_SHARES, RELIEF_DEPTH)
        return self.head_scan_texture

    @cached_property
    def head_scan_texture(self) -> Solid | None:
        """Solid texture of the scan of the whole head; None without scan."""
        if self.intensity is None:
            return None
        values = self.intensity.apply_window(self.site.anatomy.mesh)
        return Solid(values, np.linalg.inv(self.intensity.affine), DARK_SHARES, RELIEF_DEPTH)

    @cached_property
    def _drape(self) -> Layer:
        return build_drape(self.site, DRAPE, self.scene.look.natural)


def _list_visible(site: CraniotomyFrame, anatomy: Anatomy) -> np.ndarray:
    """List the surface triangles (S, 3) of the open cortex, and of the cortex near the craniotomy edge."""
    mesh = anatomy.mesh
    away = np.linalg.norm(mesh.nodes[mesh.surface] - site.origin, axis=2).min(axis=1)
    return mesh.surface[away < site.radius + RIM_DISTANCE]


@lru_cache(maxsize=2)
def _build_whole_cortex(site: CraniotomyFrame, intensity: Intensity | None) -> FineCortex:
    """Build the fine cortex of an anatomy without resection; the cached result is shared by all scenes of a patient."""
    return build_fine_cortex(site, site.anatomy.mesh, _list_visible(site, site.anatomy), intensity)


@lru_cache(maxsize=2)
def _halve_resolution(camera: Camera) -> Camera:
    """Return a camera with half the pixels along each side; the result is cached."""
    return camera.scale(0.5)
