"""Camera paths over a scene: deterministic and smooth functions of time, and rejected parameters."""

from dataclasses import replace

import numpy as np
import pytest

from scenes.script.camera_paths import PATHS, Focus, HandHeld, Microscope, Orbit, sample_hand_motion
from scenes.script.viewpoint import OBLIQUE_VIEWPOINT
from sim.errors import InputError


def test_camera_path_with_invalid_parameters_is_rejected():
    for wrong in (
        lambda: HandHeld(-1),
        lambda: Orbit(period=0.0),
        lambda: Microscope(takes=0.0),
        lambda: Microscope((Focus(2.0, 1.0, 1.0), Focus(1.0, 1.0, 1.0))),
        lambda: Microscope((Focus(0.0, 0.0, 1.0),)),
    ):
        with pytest.raises(InputError, match="give"):
            wrong()


TIMES = np.linspace(0.0, 4.0, 41)


@pytest.mark.parametrize("name", PATHS)
def test_camera_path_is_pure_and_keeps_site_in_image(site, name):
    view = replace(OBLIQUE_VIEWPOINT, path=PATHS[name](3))
    cameras = [view.build_camera(site, float(time)) for time in TIMES]
    again = [view.build_camera(site, float(time)) for time in TIMES[::-1]][::-1]
    for one, other in zip(cameras, again, strict=True):
        assert np.array_equal(one.T_camera_world, other.T_camera_world) and np.array_equal(one.K, other.K)
        at, depth = one.project(view.find_target(site))
        assert depth > 0.1 and np.abs(at - [319.5, 239.5]).max() < 100
    assert np.ptp([one.project(site.origin)[0] for one in cameras], axis=0).max() > 2.0


def test_hand_motion_is_deterministic_per_seed(site):
    one, same, other = (replace(OBLIQUE_VIEWPOINT, path=HandHeld(seed)).build_camera(site, 1.7) for seed in (5, 5, 6))
    assert np.array_equal(one.T_camera_world, same.T_camera_world)
    assert np.abs(one.T_camera_world - other.T_camera_world).max() > 1e-5
    assert PATHS["hand-held"](5) == HandHeld(5)


def test_hand_held_path_has_given_amplitude_and_breathing(site):
    ways = np.array([sample_hand_motion(seed, time) for seed in range(6) for time in np.arange(0.0, 60.0, 0.05)])
    assert ways.std(axis=0) == pytest.approx(np.ones(6), rel=0.15) and np.abs(ways.mean(axis=0)).max() < 0.1
    calm = replace(OBLIQUE_VIEWPOINT, path=HandHeld(0, shift=0.0, turn=0.0, breath=2e-3))
    start, top, back, low = (calm.build_camera(site, time).centre for time in (0.0, 1.0, 2.0, 3.0))
    assert np.linalg.norm(top - start) == pytest.approx(2e-3) and np.allclose(back, start)
    assert np.allclose(low - start, start - top)


def test_orbit_keeps_target_in_centre_at_constant_distance(site):
    view = replace(OBLIQUE_VIEWPOINT, path=Orbit(np.radians(25.0), 2.0))
    target, still = OBLIQUE_VIEWPOINT.find_target(site), OBLIQUE_VIEWPOINT.build_camera(site)
    for time in TIMES:
        camera = view.build_camera(site, float(time))
        assert camera.project(target)[0] == pytest.approx(still.project(target)[0], abs=1e-6)
        assert np.linalg.norm(camera.centre - target) == pytest.approx(0.2)
    side = view.build_camera(site, 0.5).centre
    ways = [(at - target) / 0.2 for at in (side, still.centre)]
    assert np.degrees(np.arccos(ways[0] @ ways[1])) == pytest.approx(25.0)


def test_microscope_path_moves_along_axis_zooms_and_focuses(site):
    view = replace(OBLIQUE_VIEWPOINT, path=Microscope())
    start, zoomed, far = (view.build_camera(site, time) for time in (0.0, 1.5, 2.8))
    target = OBLIQUE_VIEWPOINT.find_target(site)
    assert np.array_equal(start.K, OBLIQUE_VIEWPOINT.build_camera(site).K) and zoomed.K[0, 0] == pytest.approx(
        1.6 * start.K[0, 0]
    )
    assert far.to_camera_frame(target)[2] == pytest.approx(1.25 * 0.2)
    # Image distances f d / (d - f) at 250 and at 200 mm.
    assert far.K[0, 0] / start.K[0, 0] == pytest.approx((250 / 220) / (200 / 170))
    assert far.to_camera_frame(target)[:2] == pytest.approx(start.to_camera_frame(target)[:2], abs=1e-12)
