"""Tasks that workers take."""

from test_scenes_engine import PLAN
from tiny_work import Made, tiny_run

from scenes.episodes.run_folder import (
    begin,
    unlike,
)
from scenes.episodes.tasks import attempted


def test_a_worker_that_does_not_fit_makes_nothing(tmp_path):
    def make(number):
        raise AssertionError

    assert f"does not see {tmp_path}" in attempted(make, 0, tmp_path, tiny_run()).halt
    begin(tmp_path, tiny_run(), PLAN)
    newer = tiny_run(versions={**tiny_run().versions, "sulcus": "9"})
    assert "and not 9. Install the same there" in attempted(make, 0, tmp_path, newer).halt
    assert "of another plan or seed" in attempted(make, 0, tmp_path, tiny_run(seed=2)).halt
    assert attempted(lambda number: Made(tmp_path, 7), 0, tmp_path, tiny_run()).frames == 7
    assert unlike({"a": "1"}, {"a": "1", "b": "2"}) == "b none and not 2" and not unlike({"a": "1"}, {"a": "1"})
