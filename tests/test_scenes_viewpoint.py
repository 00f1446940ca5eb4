"""Viewpoints of scenes: eyes of a microscope, and calibrations of another image size."""

from dataclasses import replace

import pytest
from theatres import REAL

from scenes.script.viewpoint import USUAL_VIEWPOINT, Viewpoint
from sim.errors import InputError


def test_microscope_eyes_converge_at_the_site(site):
    left, right = (replace(USUAL_VIEWPOINT, eye=eye).build_camera(site) for eye in ("left", "right"))
    for one in (left, right):
        assert one.project(USUAL_VIEWPOINT.find_target(site))[0] == pytest.approx([319.5, 239.5])
    assert left.to_camera_frame(right.centre)[0] > 0.023
    with pytest.raises(InputError, match="choose left or right"):
        Viewpoint(eye="third")  # type: ignore[arg-type]


def test_calibration_of_another_image_size_is_rejected():
    with pytest.raises(InputError, match="480 x 360, not 640 x 480: calibrate with that size, or ask"):
        Viewpoint(calibration=REAL)
    view = Viewpoint().calibrate(REAL)
    assert (view.width, view.height) == (480, 360)
