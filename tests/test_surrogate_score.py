"""How deformers are scored: over all vertices, and by the worst vertex of each load."""

import numpy as np
import pytest

from surrogate.sampling import draw
from surrogate.score import score, table, winner
from surrogate.told import Told


@pytest.fixture(scope="module")
def fresh(box):
    return draw("palpation", box, 60, 99)


def test_score_sees_a_shift(pretender, box, fresh):
    truth = pretender.deform(fresh, at=box.tumour_nodes).displacement
    nothing = score("same", pretender, fresh, truth, box.tumour_nodes)
    shifted = score("shifted", pretender, fresh, truth + [0.0, 3e-3, 4e-3], box.tumour_nodes)
    assert nothing.max_mm == 0.0 and shifted.mean_mm == pytest.approx(5.0) and shifted.max_mm == pytest.approx(5.0)
    assert nothing.bare_microseconds is None and shifted.worst_mean_mm == pytest.approx(5.0)
    bent = truth.copy()
    bent[:, 3, 1] += 1e-3 * np.arange(60)
    one = score("one vertex", pretender, fresh, bent, box.tumour_nodes)
    assert (one.worst_mean_mm, one.worst_p95_mm) == pytest.approx((29.5, np.percentile(np.arange(60), 95)))
    assert winner([shifted, one, nothing]) is nothing
    assert one.mean_mm == pytest.approx(29.5 / len(box.tumour_nodes)) and one.max_mm == pytest.approx(59.0)


def test_a_table_says_what_learners_were_told(pretender, box, fresh):
    truth = pretender.deform(fresh, at=box.tumour_nodes).displacement + 1e-4
    rows = [
        score(name, pretender, fresh, truth, box.tumour_nodes, told)
        for name, told in (("it", Told(400, 60, 9000, 12, 75.5)), ("dumb", Told(400, 0, 0, 0, None)), ("fem", None))
    ]
    heads, *lines = table(rows, 1.0).splitlines()[-3:]
    assert heads.split() == ["learner", "loads", "unit", "series", "all", "inside", "seconds"]
    assert lines[0].split() == ["it", "400", "60", "9000", "9460", "12", "75.5"]
    assert lines[1].split() == ["dumb", "400", "0", "0", "400", "0", "unknown"]
    assert "told" not in table(rows[2:], 1.0)
