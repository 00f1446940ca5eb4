"""Estimated time of a run of episodes from measured rates."""

import numpy as np
import pytest

from scenes.episodes.estimate import compute_estimate, format_estimate
from scenes.episodes.rates import TaskRate, read_rates, write_rates
from scenes.episodes.tasks import TaskOutcome
from sim.errors import InputError


def test_run_time_is_estimated_from_measured_rates(tmp_path):
    (tmp_path / "rates").mkdir()
    with write_rates(tmp_path) as note:
        for number, (seconds, first) in enumerate(((30.0, "process"), (10.0, "no"), (40.0, "process"), (14.0, "no"))):
            note("episode", TaskOutcome(number, 100, 5000, seconds, first=first))
        note("body", TaskOutcome(0, 0, 2000, 60.0, first="process"))
        note("episode", TaskOutcome(9, failed="no"))
        note("episode", TaskOutcome(8, skipped=True))
        note("body", TaskOutcome(7, 0, 2000, 9.0, resumed=True))
    with next((tmp_path / "rates").glob("*.csv")).open("a") as file:
        file.write("episode,7,100,50")  # torn by a kill
    rates = read_rates(tmp_path)
    assert len(rates) == 5 and rates[4] == TaskRate("body", 0, 0, 2000, 60.0, "process")
    found = compute_estimate(rates, 1000, 10)
    assert found.seconds.mean == 12_000 + 600 and found.bytes.mean == 5_000_000 + 20_000
    assert found.frames.mean == 100_000 and found.frames.error == 0.0 and np.isnan(found.seconds.error)
    found = compute_estimate([rate for rate in rates if rate.kind == "episode"], 1000, 10)
    assert found.seconds.error == pytest.approx(1000 * np.sqrt(8.0) / np.sqrt(2.0))
    assert found.start.mean == 35.0 - 12.0 and found.start.error == pytest.approx(np.hypot(5.0, 2.0))
    assert found.estimate_duration(1000).mean == pytest.approx(23.0 + 12.0)
    assert found.estimate_duration(1).error == pytest.approx(np.hypot(found.start.error, found.seconds.error))
    text = "\n".join(format_estimate(found))
    assert "1000 episodes on 10 bodies, as measured of 4 episodes, and no body" in text
    assert "work of one process    3.33 ± 0.56 h" in text and "processes for one day  1" in text
    assert "start of a process     23 ± 5.4 s" in text and "too long" not in text
    assert "time of 512 processes  46.4 ± 6.7 s" in text
    text = "\n".join(format_estimate(compute_estimate([rate for rate in rates if rate.first == "process"], 1000, 10)))
    assert "start of a process     not known" in text and "Make 4 or more for better ones." in text
    assert "time of 1 process      9.89 ± " in text  # hours: 35 s of each, and 60 s of each body
    more = [
        *rates[1:4],
        *(TaskRate("episode", number, 100, 5000, seconds, "body") for number, seconds in ((4, 15), (5, 17))),
    ]
    one = compute_estimate(more, 1000, 10)
    assert one.start.mean == one.start.error == 28.0 and one.opening.mean == 4.0  # of one process alone
    assert one.estimate_duration(1).mean == pytest.approx(28.0 + 9 * 4.0 + 12_000.0)  # it meets all bodies
    assert one.estimate_duration(10**6).mean == pytest.approx(28.0, abs=0.1)
    with pytest.raises(InputError, match="no episode was measured"):
        compute_estimate([], 1, 1)
