"""Rough estimates of the tumour error: few draws, or loads beyond the tissue's law."""

from dataclasses import replace

import pytest

from scenes.page.text import format_position_error
from scenes.play.frame_text import format_errors, format_tumour_error
from scenes.script.uncertainty import TumourError, Uncertainty

LISTS = {"times": (0.0, 1.0), "worst": (2e-3, 4e-3), "middle": (1e-3, 1e-3), "moved": (1e-3, 1e-3)}
LISTS |= {"registered": (2e-3, 4e-3), "motion": (0.0, 1e-3)}
PARTS = {"E": (0.0, 3e-3), "registration": (2e-3, 2e-3)}


@pytest.mark.parametrize(
    ("counts", "guess"),
    [
        ({}, False),  # older files say neither
        ({"numbers": 4}, False),
        ({"numbers": 5}, True),
        ({"folded": 1}, True),
    ],
)
def test_few_draws_or_inverted_tissue_give_a_rough_estimate(counts, guess):
    found = Uncertainty("press", "mark", 9, 1, **LISTS, parts=PARTS, **counts)
    assert found.is_rough == found.evaluate(0.5).is_rough == guess
    assert found.has_few_draws == (counts.get("numbers") == 5)


def test_rough_estimate_is_labelled_without_largest_part():
    alone, seen = TumourError(4.11e-3, "E", is_rough=True), TumourError(4.11e-3, "E", 1e-3, is_rough=True)
    assert format_errors(None, alone, False)[-1] == "tumour position error <= 4.2 mm (95 %), rough estimate"
    assert format_tumour_error(seen).endswith(
        "position error <= 1.0 mm (95 %); without cortex observation: 4.2 mm, rough estimate"
    )
    for error in (alone, seen):
        named = replace(error, registration=1.56e-3)
        for words in (format_errors(None, named, False)[-1], format_position_error(named)):
            assert "clinical registration, 1.6 mm per axis" in words
    assert format_tumour_error(alone, is_brief=True) == "tumour <= 4.2 mm, rough estimate"
    assert format_tumour_error(seen, is_brief=True) == "tumour <= 1.0 mm"
