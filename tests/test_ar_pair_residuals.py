"""Residuals of single pairs: which of them is suspect."""

import numpy as np
import pytest
from test_ar_registration import SCAN, moved

from ar.tracking.pair_residuals import pair_residuals
from ar.tracking.registration import registered


def test_each_pair_s_residual_is_that_of_a_registration_without_it():
    patient = moved(SCAN) + 5e-4 * np.random.default_rng(3).normal(size=SCAN.shape)
    fits = pair_residuals(SCAN, patient)
    for row in range(len(SCAN)):
        others = registered(np.delete(SCAN, row, axis=0), np.delete(patient, row, axis=0))
        left = np.linalg.norm(others.point(SCAN[row])[0] - patient[row])
        assert fits.left_out[row] == pytest.approx(left, rel=0.02) and fits.off[row] < left
    assert np.isnan(pair_residuals(SCAN[:3], patient[:3]).chance) and not pair_residuals(SCAN[:3], patient[:3]).suspect


def test_a_wrong_pair_is_suspect_as_often_as_the_docs_say_and_sound_ones_seldom():
    rng, sound, wrong = np.random.default_rng(0), [], []
    for number in range(300):
        patient = moved(SCAN[:6]) + 5e-4 * rng.normal(size=(6, 3))
        sound.append(pair_residuals(SCAN[:6], patient).suspect)
        off = rng.normal(size=3)
        patient[number % 6] += 4e-3 * off / np.linalg.norm(off)
        fits = pair_residuals(SCAN[:6], patient)
        wrong.append(fits.suspect and fits.worst == number % 6)
    assert 0.02 < np.mean(sound) < 0.08 and 0.8 < np.mean(wrong) < 0.97
