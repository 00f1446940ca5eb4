"""Side panels of the page's 3-D view: slices of the scan, and charts of recent values."""

from dataclasses import replace

import numpy as np

from ar.page.history import Sample, Trace
from ar.page.slices import SlicedSurfaces, draw_slices
from ar.rendering.layer import Layer
from sim.deformation import Deformation
from sim.loads import Loads, Pushed

from ..play.player import Frame, Player
from ..play.stage import TOOL, TOOL_COLOUR, Stage
from ..script.scene import Scene

TUMOUR_MIDDLE, TIP = "the tumour's middle", "the tool's tip"
"""Labels of the positions of the slices."""
# Chart of the distance from tip to tumour.
DISTANCE = Trace("tip to tumour", "mm", "#f4f4f0", "band: error of the model (95 %); dotted: error unknown")
FORCE = Trace("force", "N", "#ffa94d", "band: error of the model (95 %); dotted: error unknown")  # Chart of the force.
SET_FORCE = Trace("force", "N", "#ffa94d", "as it is set")  # Chart of the prescribed force.
# Chart of the tumour's motion.
TUMOUR_MOTION = Trace("tumour moved", "mm", "#4cf28c", "band: motion error (95 %); dotted: not known")


def list_plot_lines(scene: Scene) -> tuple[Trace, ...]:
    """Return the plotted quantities: tip distance and force, or the tumour's displacement if the scene has no tool."""
    if scene.tool is None:
        return (TUMOUR_MOTION,)
    return DISTANCE, FORCE if scene.posed else SET_FORCE


def build_history_sample(frame: Frame, scene: Scene, time: float) -> Sample:
    """Build the plotted values and errors of a frame shown at a time [s], in the order of `list_plot_lines`."""
    if scene.tool is None:
        location = frame.estimate.location if frame.estimate is not None else None
        error = frame.tumour_error.bound if location is None else location.p95
        return Sample(time, (1e3 * frame.moved,), (_scale_value(error, 1e3),))
    force, force_error = get_tool_force(frame.loads, frame.deformation)
    distance = _scale_value(frame.distance, 1e3), _scale_value(frame.distance_error, 1e3)
    return Sample(time, (distance[0], force), (distance[1], force_error))


def get_tool_force(loads: Loads, deformation: Deformation) -> tuple[float | None, float | None]:
    """Return the tool force and its error bound [N], each None if not available; a prescribed force has the error 0."""
    pushed = loads.get_all(Pushed)
    if pushed:
        return float(np.linalg.norm(pushed[0].force[0])), 0.0
    if not deformation.reaction.shape[1]:
        return None, None
    bound = float(deformation.reaction_bound[0, 0])
    is_reliable = deformation.outcome[0].good and np.isfinite(bound)
    return float(np.linalg.norm(deformation.reaction[0, -1, :3])), bound if is_reliable else None


def render_slices(frame: Frame, player: Player, position: str) -> np.ndarray:
    """Render three slices (h, 3 h, 3) uint8 of a frame through `position`: `TUMOUR_MIDDLE` or `TIP`."""
    stage, positions = player.stage.select_stage(frame.loads), player.estimate_positions(frame)
    other_layers, tool = [], player.scene.tool
    if tool is not None and frame.pose is not None:
        vertices = np.asarray(tool.mesh.vertices) @ frame.pose[:3, :3].T + frame.pose[:3, 3]
        other_layers.append(Layer("tool", TOOL, vertices, np.asarray(tool.mesh.faces), TOOL_COLOUR))
    if frame.estimate is not None:
        other_layers.append(replace(stage.build_fem_tumour(player.compute_positions(frame.deformation)), name="truth"))
    tumour, scan_tumour = stage.build_tumour(positions), stage.tumour_at_rest
    cut = SlicedSurfaces(tumour, scan_tumour, frame.tumour_error.bound, bool(frame.doubt), other_layers, frame.tip)
    return draw_slices_through(player.stage, cut, position)


def draw_slices_through(stage: Stage, cut: SlicedSurfaces, position: str) -> np.ndarray:
    """Draw three slices (h, 3 h, 3) uint8 of a stage's scan through the tip (if requested and available) or centre."""
    tumour = cut.current if len(cut.current.vertices) else stage.tumour_at_rest
    centre = 0.5 * (tumour.vertices.min(axis=0) + tumour.vertices.max(axis=0))
    return draw_slices(stage.head_scan_texture, cut.tip if position == TIP and cut.tip is not None else centre, cut)


def _scale_value(value: float | None, factor: float) -> float | None:
    return None if value is None or not np.isfinite(value) else factor * value
