"""Parts of the error of an overlay: registration, latency, calibration, tracking and tissue."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ar.tracking.registration import Registration
from scenes.analysis.error_budget import (
    CLINICAL,
    LATENCY,
    MARKERS,
    MESH,
    PARAMETERS,
    SHUTTER,
    TECHNICAL,
    FilmedScene,
    compute_budget,
    sample_errors,
)
from scenes.analysis.tracking_errors import change_calibration, sample_usual_covariance
from scenes.script.craniotomy_frame import build_craniotomy_frame
from scenes.script.priors import REGISTRATION, REGISTRATION_PRIOR, SEGMENTATION, SEGMENTATION_PRIOR
from scenes.script.uncertainty import SURROGATE
from scenes.tracked.filming import USUAL_CALIBRATION, VIEW, place_reference
from sim.errors import InputError

COUNT = 200


SPEED = 0.05


DEVIATES = np.random.default_rng(5).normal(size=100)


def sideways(camera, target, time):
    """A camera that moves along its rows."""
    return camera.move(np.array([SPEED * time, 0.0, 0.0]))


@pytest.fixture(scope="module")
def filmed(box):
    site, rng = build_craniotomy_frame(box), np.random.default_rng(0)
    ball = rng.normal(size=(60, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    rest = site.origin + 0.015 * site.axis + 5e-3 * ball
    bodies = 1e-3 * rng.normal(size=(100, 1, 3)) + np.zeros_like(rest)
    return FilmedScene(
        site=site, viewpoint=VIEW, duration=2.0, T_scan_patient=place_reference(site, VIEW.build_camera(site)),
        covariance=sample_usual_covariance(USUAL_CALIBRATION), time=1.0, rest=rest,
        field=0.002 * site.axis + np.zeros_like(rest), normals=ball, velocity=np.zeros_like(rest), bodies=bodies,
        meshes=0.2 * DEVIATES, own_mesh=0.05 * DEVIATES, surrogate=0.3e-3,
    )  # fmt: skip


def test_error_is_zero_without_error_sources(filmed):
    none = sample_errors(filmed, [], 20)
    for values in (none.across, none.along, none.pixels, none.worst):
        assert np.abs(values).max() < 1e-12


def test_error_sources_have_their_given_size(filmed):
    moved = sample_errors(filmed, [REGISTRATION], COUNT)
    assert np.sqrt(np.mean(moved.middle**2)) == pytest.approx(np.sqrt(3.0) * REGISTRATION_PRIOR.range[1], rel=0.1)
    assert np.sqrt(np.mean(moved.along**2)) == pytest.approx(REGISTRATION_PRIOR.range[1], rel=0.15)
    wide = sample_errors(filmed, [SEGMENTATION], COUNT)
    assert np.quantile(wide.worst, 0.68) == pytest.approx(SEGMENTATION_PRIOR.range[1], rel=0.15)
    assert np.quantile(sample_errors(filmed, [SURROGATE], COUNT).worst, 0.95) == pytest.approx(0.3e-3, rel=0.15)
    off = 0.002 * np.abs(DEVIATES).max()
    assert sample_errors(filmed, [MESH], COUNT).worst.max() == pytest.approx(0.05 * off, rel=0.02)
    alike = replace(filmed, bodies=np.broadcast_to(filmed.field, filmed.bodies.shape))
    assert sample_errors(alike, [MESH, PARAMETERS], COUNT).worst.max() == pytest.approx(0.2 * off, rel=0.02)


def test_latency_error_equals_camera_motion_during_the_delay(filmed):
    moving = replace(filmed, viewpoint=replace(VIEW, path=sideways), latency=0.02, clock=0.0)
    found = sample_errors(moving, [LATENCY], 20)
    np.testing.assert_allclose(found.across, 0.02 * SPEED, rtol=0.05)
    assert sample_errors(replace(moving, latency=0.0), [LATENCY], 20).worst.max() < 1e-12
    assert sample_errors(replace(filmed, latency=0.02), [LATENCY], 20).worst.max() < 1e-12  # nothing moves


def test_latency_error_equals_tumour_motion_during_the_delay(filmed):
    sunk = replace(filmed, velocity=np.tile(SPEED * filmed.site.axis, (60, 1)), latency=0.02, clock=0.0)
    found = sample_errors(sunk, [LATENCY], 20)
    for each in (found.middle, found.worst):
        assert each == pytest.approx(0.02 * SPEED, rel=0.02)
    hasty = sample_errors(replace(sunk, latency=0.0, clock=0.01), [LATENCY], COUNT)  # of either sign
    assert np.sqrt(np.mean(hasty.middle**2)) == pytest.approx(0.01 * SPEED, rel=0.1)
    assert sample_errors(sunk, [SHUTTER], 20).worst.max() < 1e-12


def test_coverage_is_low_for_patients_with_larger_deviations(filmed):
    """Deviations are six times those from which the band is computed."""
    alike, others = (
        compute_budget(filmed, 100, 0, replace(filmed, bodies=k * filmed.bodies), lambda names: ()).coverage
        for k in (1.0, 6.0)
    )
    assert alike is not None and others is not None and alike[0] > 0.9 and others[0] < 0.8
    assert others[1] is not None and 0.0 < others[1] < 0.1


def test_worst_error_is_taken_at_the_farthest_point(filmed):
    bodies = np.tile(filmed.field, (100, 1, 1))
    bodies[:, 7] += 3e-3 * filmed.site.right
    found = sample_errors(replace(filmed, bodies=bodies, meshes=np.zeros(100)), [PARAMETERS], 10)
    assert found.worst == pytest.approx(3e-3, rel=0.02) and found.middle == pytest.approx(3e-3 / 60, rel=0.05)


def test_deviation_of_coverage_is_computed_over_bodies(filmed):
    """One of two bodies is always covered, the other never: deviation of a ratio of two clusters."""
    bodies = np.stack([filmed.field, filmed.field + 0.1 * filmed.site.right])
    share, deviation = compute_budget(
        filmed, 60, test_scene=replace(filmed, bodies=bodies, meshes=np.zeros(2)), progress=lambda names: ()
    ).coverage
    assert 0.3 < share < 0.7 and deviation == pytest.approx(2.0 * share * (1.0 - share))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_registration_error_uses_axes_of_the_reference_frame(filmed, axis):
    """The reference is rotated by 90 degrees; rotation about an axis through the tumour moves no centroid."""
    T, middle = filmed.T_scan_patient.copy(), (filmed.rest + filmed.field).mean(axis=0)
    T[:3, :3] = Rotation.from_euler("xyz", [90.0, 0.0, 90.0], degrees=True).as_matrix() @ T[:3, :3]
    turn, shift = np.full(6, 1e-16), np.full(6, 1e-16)
    turn[3 + axis], shift[axis] = 0.02**2, 1e-3**2
    toward = VIEW.build_camera(filmed.site).T_camera_world[2, :3]
    for apart, size in ((T[:3, axis], 0.0), (T[:3, (axis + 1) % 3], 0.02)):
        registered = Registration(np.linalg.inv(T), np.diag(turn), middle - 0.05 * apart, 1e-3, 6)
        found = sample_errors(replace(filmed, T_scan_patient=T, registration=registered), [REGISTRATION], COUNT)
        assert np.sqrt(np.mean(found.middle**2)) == pytest.approx(0.05 * size, rel=0.1, abs=2e-6)
    registered = Registration(np.linalg.inv(T), np.diag(shift), middle, 1e-3, 6)
    found = sample_errors(replace(filmed, T_scan_patient=T, registration=registered), [REGISTRATION], COUNT)
    assert np.std(found.along) == pytest.approx(1e-3 * abs(toward @ T[:3, axis]), rel=0.15, abs=2e-6)


def test_rolling_shutter_error_grows_with_camera_motion(filmed):
    calibration = replace(USUAL_CALIBRATION, readout=0.02)
    moving = replace(filmed, viewpoint=replace(VIEW, calibration=calibration, path=sideways), duration=0.1)
    camera, middle = VIEW.build_camera(moving.site), (filmed.rest + filmed.field).mean(axis=0)
    rows = [
        camera.project(place[None])[0][0, 1] for place in (middle, (filmed.T_scan_patient @ [0.03, 0.02, 0.0, 1.0])[:3])
    ]
    apart = abs(rows[1] - rows[0]) / camera.height * 0.02 * SPEED
    once, twice = (
        sample_errors(replace(moving, viewpoint=replace(moving.viewpoint, calibration=each)), [SHUTTER], 20).across
        for each in (calibration, replace(calibration, readout=0.04))
    )
    # A sheared target is taken for one that is turned, too, which takes up some of it.
    assert 0.2 * apart < np.median(once) < 2.0 * apart and np.median(twice) == pytest.approx(
        2.0 * np.median(once), rel=0.1
    )
    still = sample_errors(replace(moving, viewpoint=replace(VIEW, calibration=calibration)), [SHUTTER], 20)
    assert still.worst.max() < 1e-6
    assert sample_errors(replace(moving, viewpoint=replace(VIEW, path=sideways)), [SHUTTER], 20).worst.max() < 1e-12


def test_doubled_corner_noise_doubles_tumour_error(filmed):
    once, twice = (sample_errors(replace(filmed, corner=noise), [MARKERS], COUNT).worst for noise in (0.1, 0.2))
    assert np.median(twice) == pytest.approx(2.0 * np.median(once), rel=0.1)
    # Sixteen corners 60 mm wide, 80 mm beside the tumour.
    assert 0.05e-3 < np.median(once) < 0.5e-3


def test_calibration_covariance_and_wrong_images_raise_error(filmed):
    deviations = np.sqrt(np.diag(filmed.covariance))
    assert (deviations[:4] > 0.05).all() and (deviations[:4] < 3.0).all()
    assert change_calibration(USUAL_CALIBRATION, np.arange(9.0)).focal == (1400.0, 1401.0)
    exact = replace(filmed, covariance=np.zeros((9, 9)))  # as of a film of `sulcus film`
    assert np.abs(sample_errors(exact, TECHNICAL[:1], 20).worst).max() < 1e-9
    worse = sample_errors(replace(filmed, covariance=100.0 * filmed.covariance), TECHNICAL[:1], 50)
    assert np.median(worse.worst) > 5.0 * np.median(sample_errors(filmed, TECHNICAL[:1], 50).worst)


def test_error_band_covers_twins_but_not_other_bodies(filmed):
    here, other = (
        1e-3 * np.random.default_rng(seed).normal(size=(600, 1, 3)) + np.zeros_like(filmed.rest) for seed in (2, 3)
    )
    meshes = 0.05 * np.random.default_rng(4).normal(size=600)
    first, twins = (replace(filmed, bodies=bodies, meshes=meshes) for bodies in (here, other))
    band = np.quantile(sample_errors(first, CLINICAL, 600).worst, 0.95)
    assert 0.92 < (sample_errors(twins, CLINICAL, 600, 1).worst <= band).mean() < 0.98
    assert (sample_errors(replace(twins, bodies=6.0 * other), CLINICAL, 200, 1).worst <= band).mean() < 0.8


def test_error_parts_add_in_quadrature_and_largest_is_named(filmed):
    budget = compute_budget(filmed, 100, test_scene=filmed)
    technical, clinical = (np.median(each.middle) for each in (budget.technical, budget.clinical))
    assert technical < clinical and set(budget.alone) == set(CLINICAL)
    squares = sum(np.mean(budget.alone[name].middle ** 2) for name in TECHNICAL)
    assert np.sqrt(np.mean(budget.technical.middle**2)) == pytest.approx(np.sqrt(squares), rel=0.2)
    assert budget.find_largest("middle") == REGISTRATION and budget.coverage is not None and budget.coverage[0] > 0.8


def test_reference_outside_the_camera_view_is_rejected(filmed):
    away = filmed.T_scan_patient.copy()
    away[:3, 3] += 0.5
    with pytest.raises(InputError, match="does not see the patient's reference"):
        sample_errors(replace(filmed, T_scan_patient=away), [MARKERS], 1)
