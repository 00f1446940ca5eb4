"""Plausibility of a registration for the patient in view, from the positions of craniotomy and tool."""

import numpy as np

from ar.optics.camera import Camera
from ar.tracking.registration import Registration
from ar.tracking.targets import build_patient_reference
from sim.geometry.surface import is_enclosing

from ..play.stage import Stage
from .tracked_tool import TrackedTool

MAX_REFERENCE_DISTANCE = 0.3  # Largest distance of a reference from the craniotomy [m].
NEAR_DISTANCE = 0.2  # Distance from the head within which a tool in use comes at some time [m].
MAX_TOOL_DEPTH = 0.03  # Largest depth of a tool's tip or markers inside the brain [m]: no model includes such a cut.
# Largest distance of a laid-down tool from the head [m]: beyond, no tracker of this patient sees it.
MAX_TOOL_DISTANCE = 1.0


def describe_implausible_registration(registration: Registration, stage: Stage, camera: Camera) -> str:
    """Describe why the craniotomy's position by a registration is implausible for a camera; empty if plausible."""
    opening = stage.site.origin
    middle = 0.5 * np.array([*build_patient_reference().faces[0].size, 0.0])
    away = float(np.linalg.norm(registration.transform_point(opening)[0] - middle))
    if away > MAX_REFERENCE_DISTANCE:
        return f"the registration has the opening {1e3 * away:.0f} mm from the reference: is it another patient's?"
    if camera.to_camera_frame(opening[None])[0, 2] <= 0.0:
        return "the registration has the opening behind the camera: is it another patient's?"
    return ""


def measure_head_distance(tip: np.ndarray, stage: Stage) -> float:
    """Compute the distance [m] of a tool's tip (3,) [m] from the bounding box of the mesh."""
    nodes = stage.anatomy.mesh.nodes
    return float(np.linalg.norm(tip - np.clip(tip, nodes.min(axis=0), nodes.max(axis=0))))


def describe_tool_penetration(tool: TrackedTool, T_scan_tool: np.ndarray, stage: Stage) -> str:
    """Describe by how much tip or markers of a tool at a pose (4, 4) [m] are inside the brain; empty if plausible."""
    mesh = stage.anatomy.mesh
    corners = mesh.nodes[mesh.surface]
    for what, place in (("tip", np.zeros(3)), ("markers", np.linalg.inv(tool.T_cube_tool)[:3, 3])):
        point = T_scan_tool[:3, :3] @ place + T_scan_tool[:3, 3]
        depth = float(np.linalg.norm(corners.reshape(-1, 3) - point, axis=1).min())
        if depth > MAX_TOOL_DEPTH and is_enclosing(corners, point):
            return f"the tool's {what} would be {1e3 * depth:.0f} mm deep in the brain"
    return ""


def describe_misplaced_tool(
    tool: TrackedTool | None, T_scan_tool: np.ndarray, stage: Stage, was_near_head: bool, possible_cause: str
) -> tuple[str, bool]:
    """Return why a tool pose (4, 4) [m] is implausible (or ""), and True if the tool has been near the head.

    `was_near_head`: True if the tool was near before; `possible_cause`: question that is added to the text.
    """
    away = measure_head_distance(T_scan_tool[:3, 3], stage)
    was_near_head = was_near_head or away <= NEAR_DISTANCE
    if not was_near_head:
        never = f"the tool is {1e3 * away:.0f} mm from the head, and was never nearer than {1e3 * NEAR_DISTANCE:.0f}"
        return f"{never}: {possible_cause}", was_near_head
    if away > MAX_TOOL_DISTANCE:
        return f"the tool is {away:.1f} m from the head, which is not plausible: {possible_cause}", was_near_head
    deep = "" if tool is None else describe_tool_penetration(tool, T_scan_tool, stage)
    return f"{deep}: {possible_cause}" if deep else "", was_near_head
