"""Warnings of `sulcus locate`: registration slip, inseparable causes, and no motion.

With the shipped template and locator.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.studies.locate_study import PointModel, sample_observation
from scenes.script.shipped_files import get_template_path
from sim.bodies.meshfile import read_anatomy
from sim.bodies.open_cortex import open_cortex
from sim.effects import SKULLS
from surrogate.locating.calibration import sample_observed_patch
from surrogate.locating.causes import DRAINAGE, KINDS, OEDEMA, SWELLING, TOOL
from surrogate.locating.locator_store import load_locator, to_locator_path
from surrogate.locating.observation import Observation
from surrogate.locating.prior import compute_centroid_motion

NAMED, CLOUD = PointModel(100, 44, 1), PointModel(100, 44, 1, has_correspondences=False)


@pytest.fixture(scope="module")
def locator():
    return load_locator(to_locator_path(get_template_path()), read_anatomy(get_template_path()))


@pytest.fixture(scope="module")
def sunk(locator):
    """A motion (V, 3) [m] of the vertices that tell: the cortex sinks by 6 mm, and slides in its skull."""
    prior, body = locator.prior, locator.anatomy
    first = np.flatnonzero((prior.kind == DRAINAGE) & (prior.skull == list(SKULLS).index("slide")))[0]
    motion = np.zeros_like(body.mesh.nodes)
    motion[prior.nodes] = prior.shape[first]
    inward = float((motion[np.unique(body.open_surface)] @ open_cortex(body).axis).mean())
    return motion * 6e-3 / inward


def sideways(body, length):
    """A shift (3,) [m] along the open cortex."""
    return length * open_cortex(body).right


@pytest.mark.parametrize("length", [8e-3, 12e-3, 20e-3])
def test_lateral_registration_slip_is_reported_within_error(locator, length):
    """Only the registration is displaced."""
    seen = sample_observation(locator.anatomy, np.zeros_like(locator.anatomy.mesh.nodes), NAMED, (0, 0))
    found = locator.locate(replace(seen, now=seen.now + sideways(locator.anatomy, length)))
    assert found.slipped and not found.calibrated and "may have slipped" in found.doubt
    assert np.linalg.norm(found.centroid) < found.p95 and np.linalg.norm(found.bias) > 0.3 * length
    assert not found.cause_shares and "may have slipped" in found.named_causes


@pytest.mark.parametrize("way", ["right", "axis"])
def test_rotated_points_are_reported_as_possible_slip(locator, way):
    """Rotated by 10 degrees about their centre (tilt or twist) and shifted by 0.5 mm as by sinking."""
    axis = open_cortex(locator.anatomy).axis
    seen = sample_observation(
        locator.anatomy, np.zeros_like(locator.anatomy.mesh.nodes), PointModel(100, 90, 0), (0, 0)
    )
    turn = Rotation.from_rotvec(np.radians(10.0) * getattr(open_cortex(locator.anatomy), way))
    middle = seen.rest.mean(axis=0)
    now = middle + turn.apply(seen.now - middle) + 0.5e-3 * axis
    found = locator.locate(replace(seen, now=now, sigma=None, rigid=0.8e-3))
    assert found.slipped and not found.calibrated and np.linalg.norm(found.centroid) < found.p95
    assert np.degrees(found.rigid_alone.turn) == pytest.approx(10.0, abs=0.1) and "error of 0.5 mm and" in found.doubt
    assert "degrees, where 0.8 mm and 0.3 degrees are reported," in found.doubt
    assert "The two cannot be distinguished" in found.doubt and found.warnings == (found.doubt,)


def test_slip_report_depends_on_given_registration_error(locator):
    """A shift of 12 mm is plausible with 8 mm per axis, and suspected with 4 mm."""
    body = locator.anatomy
    seen = sample_observation(body, np.zeros_like(body.mesh.nodes), NAMED, (0, 0))
    slipped = replace(seen, now=seen.now + sideways(body, 12e-3))
    expected, far = (locator.locate(replace(slipped, rigid=rigid)) for rigid in (8e-3, 4e-3))
    assert not expected.slipped and not expected.warnings and np.linalg.norm(expected.centroid) < expected.p95
    assert far.slipped and "where 4 mm and 1.5 degrees are reported" in far.doubt


def test_verified_registration_is_not_suspected(locator):
    """With a verified registration an observation that resembles a shift counts as motion."""
    body = locator.anatomy
    seen = sample_observation(body, np.zeros_like(body.mesh.nodes), NAMED, (0, 0))
    seen = replace(seen, now=seen.now + sideways(body, 12e-3))
    doubted, believed = (locator.locate(replace(seen, checked=checked)) for checked in (False, True))
    assert doubted.slipped and not believed.slipped and not believed.doubt and not believed.warnings
    assert np.linalg.norm(believed.centroid) > np.linalg.norm(doubted.centroid) and believed.p95 < doubted.p95


def test_axial_shift_warning_names_sinking_as_alternative(locator):
    body = locator.anatomy
    seen = sample_observation(body, np.zeros_like(body.mesh.nodes), NAMED, (0, 0))
    found = locator.locate(replace(seen, now=seen.now + 12e-3 * open_cortex(body).axis))
    assert not found.slipped and found.calibrated and not found.doubt
    (said,) = found.warnings
    assert "with a brain at rest. The two cannot be distinguished. If such an error is possible" in said


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("skull", range(3))
def test_true_motion_gives_no_registration_warning(locator, skull, seed):
    """Drainage with a dent of the last tool shape; most of it resembles a shift of all points."""
    prior, body = locator.prior, locator.anatomy
    random, motion = np.random.default_rng([skull, seed]), np.zeros_like(body.mesh.nodes)
    for kind, size in ((DRAINAGE, 4.0), (SWELLING, 1.0), (TOOL, 1.0)):
        some = prior.shape[(prior.kind == kind) & (prior.skull == (skull if kind else skull % 2))][:3]
        motion[prior.nodes] += size * np.tensordot(random.standard_normal(len(some)), some, 1)
    found = locator.locate(replace(sample_observation(body, motion, NAMED, (0, seed)), rigid=0.8e-3))
    assert not found.is_registration_suspect and not any("registration" in said for said in found.warnings)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("sight", [NAMED, CLOUD])
def test_shifted_registration_gives_a_registration_warning(locator, sight, seed):
    """Only the registration is displaced, by 7 mm along and across the axis."""
    body, axis = locator.anatomy, open_cortex(locator.anatomy).axis
    seen = sample_observation(body, np.zeros_like(body.mesh.nodes), sight, (0, seed))
    shift = 5e-3 * axis + sideways(body, 5e-3)
    found = locator.locate(replace(seen, now=seen.now + shift, rigid=0.8e-3))
    assert found.is_registration_suspect and any("registration" in said for said in found.warnings)


@pytest.mark.parametrize("sight", [NAMED, CLOUD])
def test_sinking_brain_is_not_reported_as_slip(locator, sunk, sight):
    """The tumour is located, and its error is within the bound."""
    found = locator.locate(sample_observation(locator.anatomy, sunk, sight, (0, 0)))
    off = np.linalg.norm(found.centroid - compute_centroid_motion(locator.anatomy, sunk[None])[0])
    assert not found.slipped and found.calibrated and not found.doubt and off < found.p95
    assert not found.within_errors and sum(found.causes.values()) == pytest.approx(1.0)


@pytest.mark.parametrize("seed", range(4))
def test_rounding_of_cloud_points_changes_no_result(locator, sunk, seed):
    """Two triangles are equally near at an edge of the surface, and rounding selects one."""
    seen = sample_observation(locator.anatomy, sunk / 2.0, PointModel(300, 28, 2, has_correspondences=False), (0, seed))
    found, again = (locator.locate(replace(seen, now=seen.now * factor)).centroid for factor in (1.0, 1.0 + 4e-16))
    assert again == pytest.approx(found, abs=1e-8)


def test_point_cloud_does_not_separate_drainage_and_shrinking(locator):
    """All points move by 5 mm along the axis of the opening."""
    body = locator.anatomy
    still = sample_observation(
        body, np.zeros_like(body.mesh.nodes), PointModel(100, 90, 1, has_correspondences=False), (0, 0)
    )
    found = locator.locate(replace(still, now=still.now + 5e-3 * open_cortex(body).axis))
    largest = found.cause_shares[0]
    assert largest.causes == KINDS[1:3] and largest.low > 0.7 and "not separable" in found.named_causes
    assert found.causes["drainage"] > found.causes["swelling"]


@pytest.mark.parametrize("sight", [NAMED, CLOUD])
def test_motionless_observation_names_no_cause(locator, sight):
    found = locator.locate(
        sample_observation(locator.anatomy, np.zeros_like(locator.anatomy.mesh.nodes), sight, (0, 0))
    )
    assert found.within_errors and not found.cause_shares and not any(found.causes.values())
    assert found.named_causes == "none, as what was seen is within its errors"


def test_dent_of_error_size_is_detected_by_its_shape(locator):
    """Dent of 3 mm depth and 12 mm width at 60 noisy points, compared with no dent."""
    body, random = locator.anatomy, np.random.default_rng(0)
    cortex = body.mesh.nodes[np.unique(body.open_surface)]
    rest = cortex[random.choice(len(cortex), 60, replace=False)]
    middle = cortex[((cortex - cortex.mean(axis=0)) ** 2).sum(axis=1).argmin()]
    away = ((rest - middle) ** 2).sum(axis=1)
    dent = 3e-3 * np.exp(-away / (2.0 * 6e-3**2))[:, None] * open_cortex(body).axis
    white = 0.2e-3 * random.standard_normal((60, 3))
    dented, still = (locator.locate(Observation(rest + white + moved, rest)) for moved in (dent, 0.0))
    assert not dented.within_errors and dented.cause_shares and still.within_errors


def test_points_on_tiny_patch_are_marked_uncalibrated(locator, sunk):
    """The trials cover patches of a tenth to all of the open cortex, with named and unnamed points."""
    body = locator.anatomy
    for cover, known in ((0.12, True), (0.9, True), (0.01, False)):
        evidence = sample_observed_patch(body, sunk, np.random.default_rng(3), 60, cover)
        rest = evidence.positions[::3]
        now = rest + evidence.motion.reshape(-1, 3)
        for seen in (Observation(now, rest), Observation(now)):
            assert locator.locate(seen).calibrated == known, cover


@pytest.mark.parametrize("kind", [SWELLING, OEDEMA])
def test_swelling_gives_an_oedema_warning(locator, sunk, kind):
    prior, body = locator.prior, locator.anatomy
    motion = np.zeros_like(body.mesh.nodes)
    motion[prior.nodes] = prior.shape[np.flatnonzero((prior.kind == kind) & (prior.skull == 0))[0]]
    motion *= 5e-3 / np.sqrt((motion[np.unique(body.open_surface)] ** 2).sum(axis=1).mean())
    swollen, drained = (locator.locate(sample_observation(body, one, NAMED, (0, 0))).warnings for one in (motion, sunk))
    assert any("oedema" in said for said in swollen) and not any("oedema" in said for said in drained)
