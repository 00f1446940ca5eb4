"""Study of a report."""

from dataclasses import replace

from sim.accuracy import REFERENCE, TRAIN


def test_quick_and_thorough_references_are_not_confused(study):
    quick, thorough = (replace(study, thorough=thorough) for thorough in (False, True))
    assert (quick.reference_accuracy, thorough.reference_accuracy) == (TRAIN, REFERENCE)
    assert quick.digest != thorough.digest and quick.digest == study.digest
