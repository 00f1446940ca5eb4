"""Scores of deformers: over all vertices, and by the worst vertex of each load."""

from dataclasses import replace

import numpy as np
import pytest

from surrogate.data.tool_loads import draw
from surrogate.evaluation.score import (
    SolveCounts,
    compute_statistics,
    find_best_score,
    format_scores,
    score,
    score_forces,
)


@pytest.fixture(scope="module")
def fresh(box):
    return draw("palpation", box, 60, 99)


def test_score_measures_a_known_shift(pretender, box, fresh):
    truth = pretender.deform(fresh, at=box.tumour_nodes).displacement
    nothing = score("same", pretender, fresh, truth, box.tumour_nodes)
    shifted = score("shifted", pretender, fresh, truth + [0.0, 3e-3, 4e-3], box.tumour_nodes)
    assert nothing.max_mm == 0.0 and shifted.mean_mm == pytest.approx(5.0) and shifted.max_mm == pytest.approx(5.0)
    assert nothing.bare_microseconds is None and shifted.worst_mean_mm == pytest.approx(5.0)
    bent = truth.copy()
    bent[:, 3, 1] += 1e-3 * np.arange(60)
    one = score("one vertex", pretender, fresh, bent, box.tumour_nodes)
    assert (one.worst_mean_mm, one.worst_p95_mm) == pytest.approx((29.5, np.percentile(np.arange(60), 95)))
    assert find_best_score([shifted, one, nothing]) is nothing
    assert one.mean_mm == pytest.approx(29.5 / len(box.tumour_nodes)) and one.max_mm == pytest.approx(59.0)


def test_score_table_lists_solve_counts(pretender, box, fresh):
    truth = pretender.deform(fresh, at=box.tumour_nodes).displacement + 1e-4
    rows = [
        score(name, pretender, fresh, truth, box.tumour_nodes, solves)
        for name, solves in (
            ("it", SolveCounts(400, 60, 9000, 12, 75.5)),
            ("dumb", SolveCounts(400, 0, 0, 0, None)),
            ("fem", None),
        )
    ]
    heads, *lines = format_scores(rows, 1.0).splitlines()[-3:]
    assert heads.split() == ["learner", "loads", "unit", "series", "all", "inside", "seconds"]
    assert lines[0].split() == ["it", "400", "60", "9000", "9460", "12", "75.5"]
    assert lines[1].split() == ["dumb", "400", "0", "0", "400", "0", "unknown"]
    assert "solves" not in format_scores(rows[2:], 1.0)


def test_score_of_single_model_names_no_smallest_error(pretender, box, fresh):
    truth = pretender.deform(fresh, at=box.tumour_nodes).displacement + 1e-4
    one, other = (score(name, pretender, fresh, truth, box.tumour_nodes) for name in ("one", "other"))
    assert "one has the smallest error: 0.17" in format_scores([one, other], 1.0) and " is fastest, " in format_scores(
        [one, other], 1.0
    )
    alone = format_scores([one], 1.0)
    assert "smallest" not in alone and "fastest" not in alone
    assert "one: 0.1732 mm mean error at a mean motion of 1.000 mm" in alone


def test_permille_error_is_omitted_below_1000_loads(pretender, box, fresh):
    """A dash and a note replace it; from 1,000 loads on it is the 99.9th percentile."""
    distance = np.random.default_rng(0).uniform(size=(1000, 3))
    few, many = compute_statistics(distance[:999]), compute_statistics(distance)
    assert few[2] is None and many[2] == pytest.approx(np.percentile(distance, 99.9)) and few[3] <= 1.0
    assert few[:2] == pytest.approx((distance[:999].mean(), np.percentile(distance[:999], 95)))
    truth = pretender.deform(fresh, at=box.tumour_nodes).displacement + 1e-4
    row = score("few", pretender, fresh, truth, box.tumour_nodes)
    assert row.p999_mm is row.p999_percent is row.worst_p999_mm is None
    said = format_scores([row], 1.0).splitlines()
    assert said[2].split().count("-") == 3 and "not estimated from fewer than 1000 loads" in said[3]
    known = format_scores([replace(row, p999_mm=0.25, p999_percent=2.5, worst_p999_mm=0.5)], 1.0).splitlines()
    assert len(known[2]) == len(said[2]) and "0.2500" in known[2] and "fewer" not in known[3]


def test_force_score_excludes_tools_without_force():
    truth = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0], [0.0, 4.0, 0.0]])
    found = score_forces(np.array([9.0, 0.2, 0.2]), truth, np.array([[0.1, 0.3, 0.1], [0.1, 0.5, 0.4]]))
    assert (found.loads, found.force, found.shares) == (2, 3.0, (0.5, 1.0))
    assert (found.mean, found.mean_percent, found.bound) == pytest.approx((0.2, 7.5, 0.2))
