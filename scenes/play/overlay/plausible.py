"""Whether a registration can be this patient's: where it has the opening, and where the tool is beside the head."""

from __future__ import annotations

import numpy as np

from ar.optics.camera import Camera
from ar.tracking.registration import Registration
from ar.tracking.targets import patient_reference

from ..stage import Stage

# A reference is no farther from the opening, and a tool that works is at some time no farther from the head [m].
REACH, NEAR = 0.3, 0.2


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
