"""Tasks of workers."""

from test_scenes_engine import PLAN
from tiny_work import tiny_run

from scenes.episodes.run_folder import begin_run, describe_other_versions
from scenes.episodes.tasks import MadeEpisode, try_task


def test_worker_with_other_folder_or_version_makes_no_episode(tmp_path):
    def make(number):
        raise AssertionError

    assert f"does not see {tmp_path}" in try_task(make, 0, tmp_path, tiny_run()).halt
    begin_run(tmp_path, tiny_run(), PLAN)
    newer = tiny_run(versions={**tiny_run().versions, "sulcus": "9"})
    assert "and not 9. Install the same there" in try_task(make, 0, tmp_path, newer).halt
    assert "of another plan or seed" in try_task(make, 0, tmp_path, tiny_run(seed=2)).halt
    assert try_task(lambda number: MadeEpisode(tmp_path, 7), 0, tmp_path, tiny_run()).frames == 7
    assert describe_other_versions(
        {"a": "1"}, {"a": "1", "b": "2"}
    ) == "b none and not 2" and not describe_other_versions({"a": "1"}, {"a": "1"})
