"""Camera and appearance of a scene: camera pose and motion, light, colour of the cortex, and occluders."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from ar.optics.calibration import Calibration
from ar.optics.camera import Camera, build_stereo_pair, look_at
from sim.errors import InputError

from .camera_paths import CameraPath
from .craniotomy_frame import CraniotomyFrame
from .framing import Framing, compute_view_direction, find_framing


@dataclass(frozen=True)
class Cottonoid:
    """Square of wet cotton that moves with the cortex.

    Parameters
    ----------
    x, y
        Centre of the square in the tangent plane of the open cortex [m].
    side
        Side length [m].
    angle
        Rotation angle in the tangent plane [rad].
    """

    x: float
    y: float
    side: float = 12e-3
    angle: float = 0.0


BallInstrument = Literal["dissector", "forceps", "suction"]


@dataclass(frozen=True)
class Appearance:
    """Appearance of a scene: light, colour and occluders of the cortex, and camera effects.

    Parameters
    ----------
    lamp, ambient
        Intensities of the lamp and of the ambient light, in linear (not sRGB) units.
    turn
        Rotation angle of the lamp about the axis of the craniotomy [rad].
    tint
        Factors on the red, green and blue colour of the cortex.
    vessels
        Seed of vessels that are rendered on the cortex; None: no added vessels.
    cottonoids
        Squares of cotton on the cortex.
    finger
        Angle in the tangent plane [rad] of a gloved finger that extends over the craniotomy edge; None: no finger.
    natural
        True: gyri, sulci and vessels on a fine surface just below the FEM surface, instead of scan and `vessels`; a
        drape with folds, and realistic instruments. False: the FEM surface, a plain drape and simple tools, as in data
        sets.
    instrument
        Instrument that represents a `Probe` if `natural`: "dissector" with a steel ball at its end, or "forceps"
        (bipolar) or "suction" (a tube) with a ball of cotton at the tip.
    aperture, noise
        Diameter of the camera's lens [m], which blurs objects nearer or farther than the open cortex; standard
        deviation of the shot noise [share of white]. 0: no blur, no noise.

    Raises
    ------
    InputError
        The instrument is unknown, or aperture or noise is not a number >= 0.
    """

    lamp: float = 1.0
    ambient: float = 0.16
    turn: float = 0.0
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    vessels: int | None = None
    cottonoids: tuple[Cottonoid, ...] = ()
    finger: float | None = None
    natural: bool = False
    instrument: BallInstrument = "dissector"
    aperture: float = 0.0
    noise: float = 0.0

    def __post_init__(self) -> None:
        if self.instrument not in get_args(BallInstrument):
            known = ", ".join(get_args(BallInstrument))
            raise InputError(f"there is no instrument {self.instrument!r} for a ball: choose one of {known}.")
        for name in ("aperture", "noise"):
            value = getattr(self, name)
            if not (isinstance(value, int | float) and 0.0 <= value < np.inf):
                raise InputError(f"an appearance has {name} {value!r}: give a number >= 0.")


PLAIN_APPEARANCE = Appearance()
"""Appearance of data sets: the FEM surface, with the scan as texture."""
NATURAL_APPEARANCE = Appearance(natural=True)
"""Default appearance of scenes."""


WORKING_DISTANCE = 0.30  # Distance of an operating microscope from the cortex [m].
TARGET_DEPTH = 10e-3  # Depth under the cortex of the camera's target [m]: between the tool and the tumour.
Eye = Literal["left", "right"]


@dataclass(frozen=True)
class Viewpoint:
    """Camera pose relative to the open cortex.

    Parameters
    ----------
    distance
        Distance from the target [m]: by default the working distance of an operating microscope.
    tilt
        Angle [rad] between the direction to the camera and the outward normal, towards `up` of the craniotomy. None:
        the most oblique view in which the tumour is visible through the craniotomy, see `find_framing`.
    fov
        Vertical field of view [rad]. None: at the default distance, the image contains craniotomy, tumour and error
        band.
    width, height
        Image size [pixel].
    calibration
        Calibration of a real camera, instead of the field of view.
    path
        Motion, zoom and focus of the camera; None: static.
    eye
        Eye of an operating microscope, whose optical axes meet at the target; None: single central camera.
    field
        Radius of a microscope's circular field of view, relative to half of the image's longer side; the displayed
        image is dark outside. None: the complete image.

    Raises
    ------
    InputError
        The calibration does not fit the image size, `eye` is invalid, or `field` is not > 0.
    """

    distance: float = WORKING_DISTANCE
    tilt: float | None = None
    fov: float | None = None
    width: int = 640
    height: int = 480
    calibration: Calibration | None = None
    path: CameraPath | None = None
    eye: Eye | None = None
    field: float | None = None

    def __post_init__(self) -> None:
        if self.eye not in (None, "left", "right"):
            raise InputError(f"an operating microscope has no eye {self.eye!r}: choose left or right.")
        if self.field is not None and not 0.0 < self.field < np.inf:
            raise InputError(f"a round field has the radius {self.field}: give a number above 0, or None.")
        if self.calibration is not None:
            try:
                self.calibration.resize_calibration(self.width, self.height)
            except ValueError as error:
                raise InputError(str(error)) from error

    def calibrate(self, calibration: Calibration) -> Viewpoint:
        """Return the viewpoint with a calibrated camera, and the image size of the calibration."""
        return replace(self, calibration=calibration, width=calibration.width, height=calibration.height)

    def find_target(self, site: CraniotomyFrame) -> np.ndarray:
        """Return the target point (3,) [m] at which the camera looks."""
        if self.tilt is not None and (self.fov is not None or self.calibration is not None):
            return site.origin + TARGET_DEPTH * site.axis
        return self.find_framing(site).target

    def find_framing(self, site: CraniotomyFrame) -> Framing:
        """Return the framing of the tumour, with the tilt of this viewpoint unless the tilt is None."""
        direction = None if self.tilt is None else (-self.tilt, 0.0)
        return find_framing(site, WORKING_DISTANCE, self.width / self.height, direction)

    def build_camera(self, site: CraniotomyFrame, time: float = 0.0) -> Camera:
        """Build the camera that looks at a craniotomy, at a time [s] of its path."""
        target = self.find_target(site)
        outward = self.find_framing(site).direction if self.tilt is None else compute_view_direction(site, -self.tilt)
        fov = self.find_framing(site).fov if self.fov is None else self.fov
        away = self.distance
        if self.calibration is not None and self.tilt is None:  # far enough for its own field of view
            away *= max(1.0, 2.0 * self.calibration.focal[1] / self.height * np.tan(0.5 * self.find_framing(site).fov))
        found = look_at(target + away * outward, target, site.up, fov, self.width, self.height)
        if self.calibration is not None:
            found = self.calibration.build_camera(found.T_camera_world)
        if self.path is not None:
            found = self.path(found, target, time)
        if self.eye is None:
            return found
        left, right = build_stereo_pair(found, working_distance=float(found.to_camera_frame(target)[2]))
        return left if self.eye == "left" else right

    calibrated, target, camera = calibrate, find_target, build_camera  # Former names, for one release.


USUAL_VIEWPOINT = Viewpoint()
"""Default viewpoint of scenes."""
OBLIQUE_VIEWPOINT = Viewpoint(distance=0.20, tilt=-0.8, fov=float(np.radians(16.0)))
"""Oblique view, equal for every anatomy: for data sets, and for tracked cameras, which must see their targets."""
