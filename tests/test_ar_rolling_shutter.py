"""A rolling shutter: each row is drawn where the camera is when it is taken; what a picture says of that; the files."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from theatres import template_theatre

from ar.optics.calibration import opencv_text, ros_text
from ar.optics.calibration_text import parsed
from ar.optics.camera import look_at
from ar.optics.rolling_shutter import row_bands, row_time, time_of_point
from ar.rendering.layer import Layer
from ar.rendering.renderer import Lamp, Renderer
from scenes.play.player import Player
from scenes.script.camera_paths import HandHeld
from scenes.script.scene import find_scene
from scenes.tracked.filming import USUAL, VIEW, Taking, mounted, registered, shots_of
from scenes.tracked.follower import Follower, State
from scenes.tracked.tool_motion import ToolMotion
from sim.anatomy import Anatomy
from surrogate.model.learned import predicted

CAMERA = look_at(np.array([0.0, 0.0, -0.4]), np.zeros(3), np.array([0.0, -1.0, 0.0]), np.radians(16.0), 400, 300)
READOUT = 0.03
HAND = HandHeld(seed=3, turn=float(np.radians(0.5)))
GRID = np.array([[x, y, 0.0] for x in (-0.05, 0.0, 0.05) for y in (-0.04, -0.02, 0.0, 0.02, 0.04)])


@dataclass(frozen=True)
class Still:
    """A brain that is known not to move."""

    anatomy: Anatomy

    def deform(self, loads, start=None, at=None):
        every = np.arange(len(self.anatomy.mesh.nodes))
        none = np.full((2, len(loads)), np.nan)
        return predicted(np.zeros((len(loads), len(every), 3)), every, loads, [False] * len(loads), 0.0, none, "")


def camera_at(after):
    return HAND(CAMERA, np.zeros(3), 1.0 + after)


def discs(radius=3e-3, corners=48):
    """Small discs about the places of a grid, of which each has its own id."""
    angles = np.linspace(0.0, 2.0 * np.pi, corners, endpoint=False)
    rim = radius * np.column_stack([np.cos(angles), np.sin(angles), 0.0 * angles])
    ends = np.arange(corners)
    triangles = np.column_stack([0 * ends, 1 + ends, 1 + np.roll(ends, -1)])
    return [Layer(str(n), n + 1, place + np.vstack([np.zeros(3), rim]), triangles) for n, place in enumerate(GRID)]


def test_each_row_is_drawn_where_the_camera_is_when_it_is_taken():
    layers = discs()
    renderer = Renderer(layers, Lamp(np.array([0.0, 0.0, -0.4]), np.zeros(3), 0.2))
    bands = row_bands(camera_at, READOUT, GRID)
    vertices = [layer.vertices for layer in layers]
    drawn = np.concatenate([renderer.picture(camera, vertices).segmentation for _, camera in bands])
    assert drawn.shape == (300, 400) and len(bands) > 5
    still = CAMERA.project(GRID)[0]
    apart = []
    for number, place in enumerate(GRID):
        middle = np.argwhere(drawn == number + 1).mean(axis=0)[::-1]
        # By single rows: the row in which the place is seen is that which has the camera there.
        row = still[number, 1]
        for _ in range(20):
            pixel = camera_at(READOUT * (row / 299.0 - 0.5)).project(place[None])[0][0]
            row = pixel[1]
        apart.append(np.linalg.norm(middle - pixel))
        assert np.linalg.norm(camera_at(0.0).project(place[None])[0][0] - pixel) < 20.0
        assert time_of_point(camera_at, READOUT, place) == pytest.approx(row_time(row, 300, READOUT), abs=1e-6)
    assert max(apart) < 0.3
    moved = [np.linalg.norm(camera_at(0.0).project(place[None])[0][0] - still[n]) for n, place in enumerate(GRID)]
    assert max(moved) > 1.0  # the test would see a shutter that does not roll


def test_a_camera_that_stays_has_one_band_and_rows_beyond_the_picture_are_its_borders():
    ((rows, camera),) = row_bands(lambda after: CAMERA, READOUT, GRID)
    assert rows == slice(0, 300) and (camera.width, camera.height) == (400, 300)
    np.testing.assert_allclose(row_time(np.array([-5, 0, 299, 400]), 300, 0.03), [-0.015, -0.015, 0.015, 0.015])
    assert time_of_point(camera_at, READOUT, np.array([0.0, 0.0, -1.0])) == 0.0  # behind it


def test_files_have_the_readout_and_others_stay_as_they_were():
    for text in (opencv_text, ros_text):
        assert parsed(text(replace(USUAL, readout=0.0125))).readout == 0.0125
        assert "readout" not in text(USUAL) and parsed(text(USUAL)).readout == 0.0
        with pytest.raises(ValueError, match="readout_time must be a number"):
            parsed(text(USUAL) + 'readout_time: "fast"\n')
        with pytest.raises(ValueError, match="read in 0 to 1 s"):
            parsed(text(USUAL) + "readout_time: -1\n")
    assert replace(USUAL, readout=0.02).sized(640, 480, scale=True).readout == 0.02


@pytest.fixture(scope="module")
def player():
    theatre = template_theatre()
    small = replace(USUAL.sized(800, 600, scale=True), readout=READOUT)
    view = replace(VIEW.calibrated(small), path=HandHeld(0))
    return Player(theatre.stage(replace(find_scene("palpate"), viewpoint=view, duration=0.1)), Still(theatre.anatomy))


def test_a_film_rolls_and_what_is_drawn_into_it_says_how_far_off_that_makes_it(player):
    mounts = mounted(player)
    shots = list(shots_of(player, mounts, Taking(noise=0.0)))
    calibration = player.scene.viewpoint.calibration
    assert calibration is not None
    still = replace(player.scene.viewpoint, calibration=replace(calibration, readout=0.0))
    other = replace(player, stage=replace(player.stage, scene=replace(player.scene, viewpoint=still)))
    plain = next(iter(shots_of(other, mounts, Taking(noise=0.0))))
    rows = np.abs(plain.colour.astype(int) - shots[0].colour).mean(axis=(1, 2))
    assert rows[290:310].mean() < 0.4 * max(rows[:100].mean(), rows[500:].mean())  # the middle row has its time
    follower = Follower(
        calibration,
        registered(player.site, mounts, 0.0, 0.0, 0),
        mounts.tool,
        ToolMotion(player.stage, player.deformer),
    )
    known, all_known = None, []
    for shot in shots:
        known = follower.step(cv2.cvtColor(shot.colour, cv2.COLOR_RGB2GRAY), shot.time, known)
        all_known.append(known)
    # How the camera moves is not known from one picture.
    assert all_known[0].state is State.UNSURE and "rolling shutter" in all_known[0].words
    assert all(each.relied and each.parts["shutter"] > 0.0 for each in all_known[1:])
    at_once = replace(follower, calibration=replace(calibration, readout=0.0))
    alike = at_once.step(cv2.cvtColor(shots[1].colour, cv2.COLOR_RGB2GRAY), shots[1].time)
    assert alike.relied and "shutter" not in alike.parts
    assert all_known[1].band > 1.5 * alike.band
    # A hand that was fast a moment ago may be again.
    assert all_known[-1].pace >= 0.5 * max(each.pace for each in all_known[1:])
