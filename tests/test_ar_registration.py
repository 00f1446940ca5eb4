"""Registration of a scan to the patient's reference: accuracy, coverage and rejected input."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from ar.tracking.registration import compute_pair_residuals, refine_registration, register_points

SCAN = 1e-3 * np.array(
    [[70.0, 20, 30], [-65, 30, 25], [0, 95, 20], [30, 60, 80], [-40, 10, 90], [5, -80, 60], [50, -50, 70]]
)
TUMOUR = np.array([0.03, 0.01, 0.05])
TRUE = np.eye(4)
TRUE[:3, :3], TRUE[:3, 3] = Rotation.from_rotvec([0.4, -0.8, 1.9]).as_matrix(), [0.12, -0.05, 0.3]
CURVED = 0.08


def moved(points, T=TRUE):
    return points @ T[:3, :3].T + T[:3, 3]


def on_ellipsoid(points):
    """The nearest places on a surface and normals there: along the ray from the middle, which is near enough."""
    shape = np.array([1.0, 1.2, 0.8]) * CURVED
    place = points / np.linalg.norm(points / shape, axis=1, keepdims=True)
    normal = place / shape**2
    return place, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def held(found):
    at, covariance = found.transform_point(TUMOUR)
    away = at - moved(TUMOUR)
    return away @ np.linalg.solve(covariance, away) <= chi2.ppf(0.95, 3)


def test_registration_is_exact_without_noise():
    found = register_points(SCAN, moved(SCAN))
    np.testing.assert_allclose(found.T_patient_scan, TRUE, atol=1e-12)
    assert found.rms < 1e-12 and found.pair_count == 7


@pytest.mark.parametrize("count", [3, 4, 7])
def test_registration_ellipsoid_has_nominal_coverage(count):
    rng = np.random.default_rng(count)
    some = [register_points(SCAN[:count], moved(SCAN[:count]) + 7e-4 * rng.normal(size=(count, 3))) for _ in range(400)]
    assert 0.925 < np.mean([held(each) for each in some]) < 0.98


def test_traced_surface_improves_registration_accuracy():
    rng, alone, both = np.random.default_rng(1), [], []
    towards = rng.normal(size=(60, 3)) * [0.4, 0.4, 0.2] + [0.3, 0.2, 0.8]
    surface = moved(on_ellipsoid(towards)[0])
    for _ in range(60):
        patient = moved(SCAN[:4]) + 1e-3 * rng.normal(size=(4, 3))
        seen = surface + 3e-4 * rng.normal(size=surface.shape)
        alone.append(register_points(SCAN[:4], patient))
        both.append(refine_registration(SCAN[:4], patient, seen, on_ellipsoid))
    off = [[np.linalg.norm(each.transform_point(TUMOUR)[0] - moved(TUMOUR)) for each in some] for some in (alone, both)]
    assert np.median(off[1]) < 0.8 * np.median(off[0])
    assert np.mean([held(each) for each in both]) > 0.88


def test_underdetermined_registration_is_rejected():
    patient, line = moved(SCAN), SCAN[:1] + np.linspace(0.0, 1.0, 5)[:, None] * [0.1, 0.02, 0.0]
    with pytest.raises(ValueError, match="2 pairs are too few"):
        register_points(SCAN[:2], patient[:2])
    with pytest.raises(ValueError, match="points of the scan lie on a line"):
        register_points(line, moved(line))
    with pytest.raises(ValueError, match=r"lie within 0\.\d+ mm of each other: give millimetres"):
        register_points(1e-3 * SCAN, patient)
    with pytest.raises(ValueError, match=r"1\.5 times as far apart as the scan's: give both in millimetres"):
        register_points(SCAN, 1.5 * patient)
    with pytest.raises(ValueError, match="mirror image only"):
        register_points(SCAN * [1.0, 1.0, -1.0], patient)
    wrong = patient.copy()
    wrong[4] += [0.0, 0.03, 0.0]
    with pytest.raises(ValueError, match=r"pair 5 \(below the header\) fits worse"):
        register_points(SCAN, wrong)
    crossed = patient + 3e-4 * np.random.default_rng(1).normal(size=patient.shape)
    crossed[[1, 4]] = crossed[[4, 1]]
    with pytest.raises(ValueError, match=r"pairs 2 and 5 \(below the header\) are swapped: .* fit to 0\.\d mm"):
        register_points(SCAN, crossed)
    with pytest.raises(ValueError, match=r"stay .* apart"):
        register_points(SCAN, patient[::-1])
    with pytest.raises(ValueError, match="3 points of the surface are too few"):
        refine_registration(SCAN, patient, patient[:3], on_ellipsoid)
    with pytest.raises(ValueError, match=r"stay .* from the surface"):
        refine_registration(
            SCAN, patient, moved(2.0 * on_ellipsoid(np.random.default_rng(0).normal(size=(50, 3)))[0]), on_ellipsoid
        )


def test_held_out_residual_uses_registration_of_other_pairs():
    patient = moved(SCAN) + 5e-4 * np.random.default_rng(3).normal(size=SCAN.shape)
    fits = compute_pair_residuals(SCAN, patient)
    for row in range(len(SCAN)):
        others = register_points(np.delete(SCAN, row, axis=0), np.delete(patient, row, axis=0))
        left = np.linalg.norm(others.transform_point(SCAN[row])[0] - patient[row])
        assert fits.held_out[row] == pytest.approx(left, rel=0.02) and fits.residuals[row] < left
    assert (
        np.isnan(compute_pair_residuals(SCAN[:3], patient[:3]).p_value)
        and not compute_pair_residuals(SCAN[:3], patient[:3]).has_outlier
    )


def test_wrong_pair_detection_rate_matches_docs():
    rng, sound, wrong = np.random.default_rng(0), [], []
    for number in range(300):
        patient = moved(SCAN[:6]) + 5e-4 * rng.normal(size=(6, 3))
        sound.append(compute_pair_residuals(SCAN[:6], patient).has_outlier)
        off = rng.normal(size=3)
        patient[number % 6] += 4e-3 * off / np.linalg.norm(off)
        fits = compute_pair_residuals(SCAN[:6], patient)
        wrong.append(fits.has_outlier and fits.worst_pair == number % 6)
    assert 0.02 < np.mean(sound) < 0.08 and 0.8 < np.mean(wrong) < 0.97
