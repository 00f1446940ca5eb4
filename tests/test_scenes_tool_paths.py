"""Tool paths: presses, slides and draws as functions of time."""

import numpy as np
import pytest
from test_scenes import sampled

from scenes.script.tool_paths import IDLE_HEIGHT, Touch, draw, lay, palpate, press, slide, smooth_step

START, END = (-0.01, -0.004), (0.008, 0.006)
PATHS = {
    "press": press(0.25, rise=1.0, hold=0.5, at=(0.003, -0.002)),
    "slide": slide(0.2, START, END, seconds=2.0, rise=0.5),
    "draw": draw(0.3, tilt=0.6, rise=1.0, hold=1.0),
}
LENGTH = {"press": 2.5, "slide": 3.0, "draw": 3.5}


class TestPaths:
    def test_smooth_is_the_minimum_jerk_profile(self):
        t = np.linspace(-0.5, 1.5, 2001)
        s = np.array([smooth_step(x) for x in t])
        assert (s[t <= 0] == 0.0).all() and (s[t >= 1] == 1.0).all() and (np.diff(s) >= 0.0).all()
        assert np.allclose(s + s[::-1], 1.0)
        inner = t[(t > 0) & (t < 1)]
        rate = np.gradient(s, t)[(t > 0) & (t < 1)]
        assert np.allclose(rate, 30.0 * inner**2 * (1.0 - inner) ** 2, atol=1e-4)

    @pytest.mark.parametrize("name", PATHS)
    def test_path_starts_and_ends_at_rest_without_force(self, name):
        path, end = PATHS[name], LENGTH[name]
        edge = sampled(path, [-1.0, 0.0, 1e-4, end - 1e-4, end, end + 1.0])
        assert (edge[[0, 1], 2] == 0.0).all() and np.allclose(edge[[4, 5], 2], 0.0, atol=1e-15)
        assert np.abs(edge[2] - edge[1]).max() / 1e-4 < 1e-6 and np.abs(edge[4] - edge[3]).max() / 1e-4 < 1e-6

    @pytest.mark.parametrize("name", PATHS)
    def test_path_is_continuous_with_non_negative_force(self, name):
        step = 1e-3
        motion = sampled(PATHS[name], np.arange(0.0, LENGTH[name] + 0.5, step))
        assert motion[:, 2].min() >= -1e-15
        speed, acceleration = np.diff(motion, axis=0) / step, np.diff(motion, 2, axis=0) / step**2
        assert np.abs(speed).max() < 2.0 and np.abs(np.diff(acceleration, axis=0)).max() < 0.25

    def test_press_holds_its_force_and_position(self):
        motion = sampled(PATHS["press"], np.linspace(1.0, 1.5, 11))
        assert np.allclose(motion, [0.003, -0.002, 0.25, 0.0, 0.0])

    def test_slide_moves_from_start_to_end_under_full_force(self):
        motion = sampled(PATHS["slide"], np.linspace(0.5, 2.5, 101))
        assert np.allclose(motion[:, 2], 0.2)
        assert np.allclose(motion[0, :2], START) and np.allclose(motion[-1, :2], END)
        along = (motion[:, :2] - START) @ np.subtract(END, START)
        assert (np.diff(along) >= 0.0).all() and not motion[:, 3:].any()

    def test_draw_tilts_the_force_and_keeps_its_direction(self):
        motion = sampled(PATHS["draw"], np.linspace(0.0, 2.5, 251))
        assert motion[0, 3] == 0.0 and (np.diff(motion[:, 3]) >= 0.0).all() and not motion[:, 4].any()
        held = motion[np.linspace(0.0, 2.5, 251) >= 1.5]
        assert np.allclose(held[:, 2], 0.3) and np.allclose(held[:, 3], 0.6)

    def test_lay_tilts_the_tool_towards_x_and_keeps_the_pose(self):
        path = lay(3e-3, tilt=0.4, rise=1.0, at=(0.002, -0.001))
        assert path(-1.0).depth == path(0.0).depth == -IDLE_HEIGHT and path(0.5).depth == pytest.approx(
            0.5 * (3e-3 - IDLE_HEIGHT)
        )
        for time in (1.0, 5.0):
            assert path(time) == Touch(0.002, -0.001, 0.0, (0.4, 0.0), pytest.approx(3e-3))

    def test_palpation_path_lowers_slides_and_lifts_the_tool(self):
        path = palpate(2e-3, START, END, seconds=2.0, rise=0.5)
        assert path(0.0).depth == -IDLE_HEIGHT and path(3.0).depth == pytest.approx(-IDLE_HEIGHT)
        for time, place in ((0.5, START), (1.5, np.mean([START, END], axis=0)), (2.5, END)):
            touch = path(time)
            assert (touch.x, touch.y, touch.depth) == pytest.approx((*place, 2e-3)) and touch.force == 0.0

    def test_path_is_a_function_of_time_only(self):
        for path in PATHS.values():
            first = path(0.7)
            path(2.0)
            assert path(0.7) == first
