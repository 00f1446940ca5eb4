"""Plausibility of a registration and of a tool pose."""

from dataclasses import replace

import numpy as np
from test_scenes_overlay import INK, pictures

from ar.overlay.outlines import find_colour
from scenes.tracked.follower import TumourState
from scenes.tracked.overlay_painter import Painter
from scenes.tracked.plausible import describe_implausible_registration


def test_implausible_registration_and_tool_are_unreliable(follower, stage):
    first = next(iter(pictures())).source
    T = follower.registration.T_patient_scan.copy()
    T[:3, 3] += [0.0, 0.0, -0.4]
    other = replace(follower, registration=replace(follower.registration, T_patient_scan=T))
    known = other.track(first.grey, 0.0)
    assert known.state is TumourState.UNSURE and known.bound is None and "mm from the reference" in known.warning
    painted = Painter(stage, follower.tool).paint(first.colour, known).colour
    assert np.count_nonzero(find_colour(painted, INK)) < 5
    near = follower.track(first.grey, 0.0)
    behind = replace(near.camera, T_camera_world=np.diag([1.0, -1.0, -1.0, 1.0]) @ near.camera.T_camera_world)
    assert "behind the camera" in describe_implausible_registration(follower.registration, stage, behind)
    long = follower.tool.T_cube_tool @ [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.4], [0, 0, 0, 1.0]]
    away = replace(follower, tool=replace(follower.tool, T_cube_tool=long))
    known = away.track(first.grey, 0.0)
    assert known.state is TumourState.UNSURE and "never nearer than 200" in known.warning and not known.was_near
    assert near.was_near and away.track(first.grey, 0.1, near).was_near  # it has been there
    assert "head" not in away.track(first.grey, 0.1, near).warning
