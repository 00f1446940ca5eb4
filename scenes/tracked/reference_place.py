"""Where the patient's reference stands when a scene is filmed: beside the opening, turned towards the camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ar.optics.calibration import Calibration
from ar.optics.camera import Camera
from ar.optics.lens import Lens
from ar.tracking.targets import patient_reference

from ..script.site import Site
from ..script.viewpoint import Viewpoint

USUAL = Calibration((1400.0, 1400.0), (620.0, 540.0), 1280, 960, Lens(-0.1, 0.02, 5e-4, -3e-4), "sulcus film")
"""The camera of a film that says nothing else."""
VIEW = Viewpoint(distance=0.32).calibrated(USUAL)
"""At arm's length: it sees the opening, the reference beside it and the tool's cube."""
# The reference's middle from the site, to the right, up and outwards [m]; turned from the line of sight [degree].
BESIDE, TURNED = (-0.078, 0.010, 0.022), (28.0, -24.0)


def from_where_it_sees_all(view: Viewpoint) -> Viewpoint:
    """The same camera, from where its picture shows as much as that of `VIEW` does."""
    assert view.calibration is not None
    longer = (view.calibration.focal[1] / view.height) / (USUAL.focal[1] / USUAL.height)
    return replace(view, distance=longer * VIEW.distance)


def reference_beside(site: Site, camera: Camera) -> np.ndarray:
    """T_scan_patient (4, 4) of the reference beside a site, as `camera` sees it from in front."""
    right, up, outwards = BESIDE
    middle = site.origin + right * site.right + up * site.up - outwards * site.axis
    T = np.eye(4)
    T[:3, :3] = camera.T_camera_world[:3, :3].T @ Rotation.from_euler("xy", TURNED, degrees=True).as_matrix()
    T[:3, 3] = middle - T[:3, :3] @ [*(0.5 * patient_reference().faces[0].size), 0.0]
    return T
