"""Stereo observation of the open cortex: tracked points, rejected images, and the resulting estimate."""

from dataclasses import replace

import numpy as np
import pytest
from programs import main
from theatres import template_theatre

from ar.overlay.outlines import compute_silhouette
from benchmarks.studies.stereo_study import summarise_seed
from scenes.play.deformers import RestDeformer
from scenes.play.player import REJECTED_WARNING, Player
from scenes.play.stereo_observer import StereoObserver
from scenes.script.observation_models import StereoObservation
from scenes.script.scene import find_scene
from scenes.script.shipped_files import get_template_path
from sim.deformation import Outcome
from sim.errors import InputError
from sim.geometry.closest_point import find_closest_points
from surrogate.locating.locator_store import to_locator_path

EXACT = StereoObservation(shift=0.0, turn=0.0)
MICROSCOPE = find_scene("microscope")
NONE = np.zeros((0, 3))


def observer_of(model: StereoObservation = EXACT) -> StereoObserver:
    """On few pixels."""
    theatre = replace(template_theatre(), locator_file=to_locator_path(get_template_path()))
    scene = replace(MICROSCOPE, viewpoint=replace(MICROSCOPE.viewpoint, width=400, height=300), observation_model=model)
    return theatre.build_stage(scene).observer


@pytest.fixture(scope="module")
def observer():
    return observer_of()


@pytest.fixture(scope="module")
def rest(observer):
    return observer.stage.site.anatomy.mesh.nodes


@pytest.fixture(scope="module")
def moved(observer, rest):
    """The body 3 mm aside and 2 mm deeper, less at one side."""
    site = observer.stage.site
    share = 1.0 + 8.0 * (rest - site.origin) @ site.up
    return rest + share[:, None] * (3e-3 * site.right + 2e-3 * site.axis)


@pytest.fixture(scope="module")
def shot(observer, moved):
    return observer.render_pair(30, moved)


@pytest.fixture(scope="module")
def seen(observer, shot):
    return observer.observe(shot, NONE)


def truly(observer, moved, points):
    """How material points (n, 3) [m] at rest moved."""
    anatomy = observer.stage.site.anatomy
    surface = anatomy.open_surface
    place = find_closest_points(points, anatomy.mesh.nodes[surface])
    return np.einsum("nc,nci->ni", place.weights, (moved - anatomy.mesh.nodes)[surface[place.triangle]])


def test_stereo_points_move_with_cortex_within_their_errors(observer, moved, seen):
    assert len(seen.now) > 60
    off = seen.now - seen.rest - truly(observer, moved, seen.rest)
    assert np.linalg.norm(off.mean(axis=0)) < 0.15e-3
    assert np.median(np.linalg.norm(off, axis=1)) < 0.4e-3
    # What is stated holds smooth errors too.
    assert 0.15 < np.sqrt(((off / seen.sigma[:, None]) ** 2).mean()) < 0.8


def test_stereo_images_depend_on_the_seed(observer, moved, shot):
    again = observer_of()
    same, other = again.render_pair(30, moved), observer_of(replace(EXACT, seed=1)).render_pair(30, moved)
    for one, two, three in zip(shot.images, same.images, other.images, strict=True):
        assert np.array_equal(one, two) and np.abs(one.astype(float) - three).mean() > 2.0
    assert not np.array_equal(observer.render_pair(31, moved).images[0], shot.images[0])
    assert shot.images[1].mean() < 0.93 * shot.images[0].mean()


def test_tracking_error_moves_all_stereo_points_rigidly(observer, shot, seen):
    off = observer_of(replace(EXACT, shift=1e-3, turn=np.radians(1.0))).observe(shot, NONE)
    plain = observer_of(EXACT).observe(shot, NONE)
    assert np.allclose(plain.now, seen.now)
    away = np.linalg.norm(off.now[:, None] - plain.now, axis=2)
    pair = np.flatnonzero(away.min(axis=1) < 2e-3)  # a point at the edge of what is seen may be in one of them alone
    assert len(pair) > 0.95 * max(len(off.now), len(plain.now))
    moved_so, as_it_is = off.now[pair], plain.now[away.argmin(axis=1)[pair]]
    assert 0.5e-3 < np.linalg.norm(moved_so.mean(axis=0) - as_it_is.mean(axis=0)) < 1.5e-3
    spread = [each - each.mean(axis=0) for each in (moved_so, as_it_is)]
    turn, _ = np.linalg.lstsq(spread[1], spread[0], rcond=None)[:2]
    assert np.linalg.norm(turn - np.eye(3), 2) == pytest.approx(np.radians(1.0), rel=0.3)


def test_tool_hides_stereo_points_without_moving_others(observer, moved, seen):
    site, scene = observer.stage.site, observer.stage.scene
    inward, tip = site.axis, site.origin + 3e-3 * site.right - 2e-3 * site.axis
    corners = observer.stage.compute_tool_corners(scene.tool.pose(tip, inward, site.right))
    found = observer.observe(observer.render_pair(30, moved, corners), NONE)
    assert 20 < len(found.now) < len(seen.now)
    left = observer.render_pair(30, moved, corners).cameras[0]
    hidden = compute_silhouette(left, corners, np.asarray(scene.tool.mesh.faces))
    column, row_ = left.project(found.now)[0].round().astype(int).T
    assert hidden.any() and not hidden[row_, column].any()
    off = found.now - found.rest - truly(observer, moved, found.rest)
    assert np.quantile(np.linalg.norm(off, axis=1), 0.9) < 1.2e-3


def test_unnamed_stereo_points_lie_on_the_moved_cortex(moved, shot):
    observer = observer_of(replace(EXACT, named=False))
    found = observer.observe(shot, NONE)
    surface = observer.stage.site.anatomy.open_surface
    off = np.linalg.norm(find_closest_points(found.now, moved[surface]).point - found.now, axis=1)
    assert found.rest is None and len(found.now) > 60 and np.median(off) < 0.3e-3


def test_cortex_without_scan_has_vessels_for_stereo_tracking(observer):
    """Heads without T1 get the same vessels on uniform tissue."""
    bare = replace(observer, stage=replace(observer.stage, intensity=None))
    assert len(bare.first_view.rest_positions) > 60
    plain = replace(
        bare, stage=replace(bare.stage, scene=replace(MICROSCOPE, observation_model=StereoObservation(vessels=False)))
    )
    assert plain.stage.scan_texture is None


class TestRefusals:
    def refusal(self, observer, shot):
        with pytest.raises(InputError) as refused:
            observer.observe(shot, NONE)
        return str(refused.value)

    def test_dark_eye_is_rejected(self, observer, shot):
        dark = replace(shot, images=(shot.images[0], np.zeros_like(shot.images[1])))
        assert "the right eye sees nothing" in self.refusal(observer, dark)

    def test_motion_beyond_the_search_range_is_rejected(self, observer, rest):
        far = observer.render_pair(30, rest + 12e-3 * observer.stage.site.right)
        assert "begin with a new scan" in self.refusal(observer, far)

    def test_swapped_eyes_are_rejected(self, observer, shot, rest):
        assert "which is which" in self.refusal(observer, replace(shot, cameras=shot.cameras[::-1]))
        later = self.refusal(observer, replace(shot, images=shot.images[::-1]))
        assert "check that eyes are not swapped" in later or "calibrate the pair again" in later
        swapped = observer_of()
        first = swapped.render_pair(-1, rest)
        vars(swapped)["_first_shot"] = replace(first, images=first.images[::-1])
        said = self.refusal(swapped, replace(shot, images=shot.images[::-1]))
        assert "from the scan's" in said or "places of the cortex" in said or "pixels apart" in said

    def test_wrong_stereo_calibration_is_rejected(self, observer, shot, rest):
        turned = shot.cameras[0], shot.cameras[1].perturb(0.08, (1.0, 0.0, 0.0))
        assert "calibrate the pair again" in self.refusal(observer, replace(shot, cameras=turned))
        later = replace(shot, cameras=(shot.cameras[0], shot.cameras[1].perturb(0.1)))
        assert "round the opening seems to have moved" in self.refusal(observer, later)
        crossed = observer_of()
        first = crossed.render_pair(-1, rest)
        vars(crossed)["_first_shot"] = replace(first, cameras=(first.cameras[0], first.cameras[1].perturb(0.1)))
        assert "mm from the scan's" in self.refusal(crossed, shot)

    def test_cortex_without_texture_is_rejected(self, observer, shot):
        plain = observer_of(replace(EXACT, vessels=False))
        assert "places of the cortex surely: check light" in self.refusal(plain, shot)

    def test_hidden_cortex_is_rejected(self, observer, shot):
        near, far = shot.cameras[0].centre, observer.stage.site.origin
        middle = near + 0.3 * (far - near)
        corners = middle + 0.1 * np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, -1.0, -1.0]])
        faces = np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])
        assert "both eyes see 0 of" in self.refusal(observer, replace(shot, tool=(corners, faces)))

    def test_invalid_stereo_parameters_are_rejected(self):
        for wrong in ({"darker": 1.0}, {"points": 5}, {"noise": -1.0}, {"seed": -1}):
            with pytest.raises(InputError):
                StereoObservation(**wrong)


def test_tumour_is_located_and_dark_eye_is_rejected(observer, moved):
    found = observer.estimate(30, moved)
    assert found.is_covered and found.error < 0.6 * np.linalg.norm(found.true_motion) and found.location.calibrated
    stage = replace(observer.stage, observer=replace(observer, observation_model=replace(EXACT, darker=0.999)))
    still = RestDeformer(stage.site.anatomy)
    player = Player(stage, still)
    answer = replace(still.deform(player.build_loads(0)), outcome=(Outcome.CONVERGED,))
    frame = player.draw_frame(0, player.get_touch(0), player.build_loads(0), answer, 0.0)
    assert (
        frame.doubt == REJECTED_WARNING and frame.estimate.location is None and not len(frame.estimate.observation.now)
    )
    assert "sees nothing" in frame.estimate.rejection and frame.moved == 0.0


def test_study_summary_counts_rejected_frames(observer, moved):
    good, none = (
        observer.estimate(30, moved),
        replace(observer, observation_model=replace(EXACT, darker=0.999)).estimate(3, moved),
    )
    found = summarise_seed(4, [good, good, none])
    assert (found.seed, found.frames, found.refused) == (4, 3, 1) and found.covered == float(good.is_covered)
    length = float(np.linalg.norm(good.true_motion))
    assert found.most_mm == pytest.approx(1e3 * length) and found.off_mm == pytest.approx(1e3 * good.error)
    assert found.removed == pytest.approx(1.0 - (2.0 * good.error + length) / (3.0 * length))


def test_microscope_benchmark_rejects_scene_without_stereo(capsys):
    assert main(["benchmarks", "microscope", "--scene", "sag", "--device", "cpu"]) == 2
    assert "no pair of eyes sees the scene sag" in capsys.readouterr().err
