"""Plausibility of another tracker's poses and of a registration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ar.optics.camera import Camera
from ar.tracking.pose import Pose
from ar.tracking.registration import Registration
from ar.tracking.targets import patient_reference
from sim.geometry.surface import encloses

from ..play.stage import Stage
from .tracked_tool import TrackedTool

# A printed target is no farther from the body that carries it [m], and stays where it is on it but for this [m].
FARTHEST, LOOSE = 0.2, 5e-3
# Poses of targets that are less well known say nothing [m]; so many pictures are remembered, and so many are enough.
KNOWN, KEPT, FEWEST = 2e-3, 30, 4
# Bodies that lie so many times nearer to the target when the two files change places are swapped, beyond this [m].
NEARER, BESIDE = 3.0, 0.02
# Of the pictures that are remembered, so many in 100 count: one in ten may be misread.
MOST = 90.0
REMEDY = "see --poses and --clock"
# A reference is no farther from the opening, and a tool that works is at some time no farther from the head [m]. Nor
# are its tip or its markers deeper inside the brain: no model knows of such a cut.
REACH, NEAR, DEEP = 0.3, 0.2, 0.03
# A tool that was near is laid aside no farther from the head [m]: beyond, no tracker of this patient sees it.
FAR = 1.0


@dataclass(frozen=True, eq=False)
class Agreement:
    """Where printed targets were seen beside the bodies that carry them, in the last pictures.

    Parameters
    ----------
    places
        By the target's name: places in the body's frame (n, 3) [m].
    doubts
        By the target's name: what the last picture that shows it says against the poses; empty: nothing.
    """

    places: Mapping[str, np.ndarray] = field(default_factory=dict)
    doubts: Mapping[str, str] = field(default_factory=dict)

    @property
    def doubt(self) -> str:
        """What speaks against the poses, in words; empty: nothing."""
        return next(filter(None, self.doubts.values()), "")

    def seen(self, name: str, target: Pose, body: Pose, swapped: Pose | None) -> Agreement:
        """With one more picture: a target as it is seen, its body as poses have it, and as the other's file has it.

        All are in one frame. A target whose place is not well known says nothing.
        """
        if np.linalg.eigvalsh(target.covariance[:3, :3])[-1] > KNOWN**2:
            return self
        place, other = (None if each is None else _beside(target, each) for each in (body, swapped))
        assert place is not None
        places = np.vstack([self.places.get(name, np.empty((0, 3))), place])[-KEPT:]
        doubt = _doubt(name, places, other)
        return Agreement({**self.places, name: places}, {**self.doubts, name: doubt})


def _beside(target: Pose, body: Pose) -> np.ndarray:
    """Where a target is in a body's frame (3,) [m]."""
    return (np.linalg.inv(body.T_camera_target) @ target.T_camera_target)[:3, 3]


def _doubt(name: str, places: np.ndarray, swapped: np.ndarray | None) -> str:
    """What places (n, 3) [m] of a target on its body say against the poses; the newest is the last."""
    away = float(np.linalg.norm(places[-1]))
    if swapped is not None and away > BESIDE and NEARER * np.linalg.norm(swapped) < away:
        return f"the {name}'s target is seen {1e3 * away:.0f} mm from its poses: are the two files of --poses swapped?"
    if away > FARTHEST:
        return f"the {name}'s target is seen {1e3 * away:.0f} mm from its poses: {REMEDY}"
    moved = np.percentile(np.linalg.norm(places - np.median(places, axis=0), axis=1), MOST)
    if len(places) >= FEWEST and moved > LOOSE:
        return f"the {name}'s target moves by {1e3 * moved:.0f} mm on the body that its poses have: {REMEDY}"
    return ""


def implausible(registration: Registration, stage: Stage, camera: Camera) -> str:
    """Say what is wrong with where a registration has the opening, as a camera sees it; empty: nothing."""
    opening = stage.site.origin
    middle = 0.5 * np.array([*patient_reference().faces[0].size, 0.0])
    away = float(np.linalg.norm(registration.point(opening)[0] - middle))
    if away > REACH:
        return f"the registration has the opening {1e3 * away:.0f} mm from the reference: is it another patient's?"
    if camera.in_frame(opening[None])[0, 2] <= 0.0:
        return "the registration has the opening behind the camera: is it another patient's?"
    return ""


def from_head(tip: np.ndarray, stage: Stage) -> float:
    """How far a tool's tip (3,) [m] is from the box round the head's mesh [m]."""
    nodes = stage.anatomy.mesh.nodes
    return float(np.linalg.norm(tip - np.clip(tip, nodes.min(axis=0), nodes.max(axis=0))))


def buried(tool: TrackedTool, T_scan_tool: np.ndarray, stage: Stage) -> str:
    """Say that a tool at a pose (4, 4) [m] is where none can be, with its tip or its markers deep inside; empty: no."""
    mesh = stage.anatomy.mesh
    corners = mesh.nodes[mesh.surface]
    for what, place in (("tip", np.zeros(3)), ("markers", np.linalg.inv(tool.T_cube_tool)[:3, 3])):
        point = T_scan_tool[:3, :3] @ place + T_scan_tool[:3, 3]
        depth = float(np.linalg.norm(corners.reshape(-1, 3) - point, axis=1).min())
        if depth > DEEP and encloses(corners, point):
            return f"the tool's {what} would be {1e3 * depth:.0f} mm deep in the brain"
    return ""


def misplaced_tool(
    tool: TrackedTool | None, T_scan_tool: np.ndarray, stage: Stage, near: bool, theirs: str
) -> tuple[str, bool]:
    """Say why a tool's pose (4, 4) [m] can be none on this patient, if so; and whether the tool has been near the head.

    `near` says whether it was before, and `theirs` asks what may be wrong.
    """
    away = from_head(T_scan_tool[:3, 3], stage)
    near = near or away <= NEAR
    if not near:
        never = f"the tool is {1e3 * away:.0f} mm from the head, and was never nearer than {1e3 * NEAR:.0f}"
        return f"{never}: {theirs}", near
    if away > FAR:
        return f"the tool is {away:.1f} m from the head, which is not plausible: {theirs}", near
    deep = "" if tool is None else buried(tool, T_scan_tool, stage)
    return f"{deep}: {theirs}" if deep else "", near
