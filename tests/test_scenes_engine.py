"""Episodes by many processes: existing episodes are skipped, failures are recorded and counted."""

import json
import os
import shutil
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest
from distributed import Client, Scheduler, Security, SpecCluster
from tiny_work import Trouble, held, played, tiny_run, to_body_path, tried

from scenes.episodes.engine import RunStatistics, list_missing_episodes
from scenes.episodes.run_folder import (
    Failure,
    begin_run,
    list_failed,
    list_failures,
    list_finished,
    mark_failed,
    read_failure,
    read_run,
)
from scenes.episodes.workers import connect_workers, start_local_workers
from sim.errors import InputError

PLAN = 'title = "tiny"\n'


@pytest.fixture(scope="module")
def workers():
    with start_local_workers(["cpu", "cpu"]) as found:
        yield found


@pytest.fixture(scope="module")
def undisturbed(workers, tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    assert played(folder, workers, 12) == RunStatistics(made=12, frames=36, bytes=sum(map(len, held(folder).values())))
    return held(folder)


def test_existing_episodes_are_skipped_in_any_order(workers, undisturbed, tmp_path):
    assert len(undisturbed) == 12
    assert played(tmp_path, workers, 3).made == 3  # upwards
    assert played(tmp_path, workers, 12).made == 9  # in a random order
    assert held(tmp_path) == undisturbed
    before = len(tried(tmp_path))
    assert played(tmp_path, workers, 12) == RunStatistics(skipped=12) and len(tried(tmp_path)) == before
    assert (tmp_path / "plan.toml").read_text() == PLAN and read_run(tmp_path) == tiny_run()


def test_episodes_of_another_client_are_not_made_again(workers, undisturbed, tmp_path):
    def others(kind, outcome, count):
        for name, content in undisturbed.items():
            (tmp_path / name).write_bytes(content)

    tally = played(tmp_path, workers, 12, heard=others)
    assert tally.made + tally.skipped == 12 and tally.skipped >= 5 and held(tmp_path) == undisturbed


def test_failed_episodes_are_recorded_and_counted(workers, tmp_path):
    trouble = Trouble({1: "does not converge", 2: "broken"}, {1: "does not mesh"})
    tally = played(tmp_path, workers, 11, trouble)
    assert (tally.made, tally.failed, tally.lost) == (4, 6, 1)
    found = list_failures(tmp_path)
    assert found[1].reason == "does not converge" and not found[1].lost
    assert found[2].reason == "RuntimeError: the card has failed" and found[2].lost
    assert sum(line.startswith("2 ") for line in tried(tmp_path)) == 1 + 3  # retries
    assert all(found[number].reason == "its body 1: does not mesh" for number in range(5, 10))
    assert list_finished(tmp_path) == {0, 3, 4, 10}
    assert json.loads((tmp_path / "failed/episode_000001.json").read_text())["reason"] == "does not converge"
    tally = played(tmp_path, workers, 11)  # what was lost has more luck, what failed is not tried again
    assert (tally.made, tally.skipped, tally.failed, tally.lost) == (1, 4, 6, 0)
    assert sorted(list_failures(tmp_path)) == [1, *range(5, 10)]
    tally = played(tmp_path, workers, 11, again=True)
    assert (tally.made, tally.skipped, tally.failed) == (6, 5, 0) and not list_failures(tmp_path)


def test_full_disk_ends_the_run_with_a_message(workers, tmp_path):
    with pytest.raises(InputError, match="No space left on device"):
        played(tmp_path, workers, 12, Trouble({1: "full"}))
    assert sum(line.startswith("1 ") for line in tried(tmp_path)) == 1 and not list_failures(tmp_path)
    assert played(tmp_path, workers, 12).failed == 0 and len(held(tmp_path)) == 12


def test_each_worker_uses_one_gpu_and_is_replaced_after_failure(undisturbed, tmp_path):
    """After a failed GPU its process is replaced, and the episode is tried again."""
    with start_local_workers(["cuda:0", "cuda:1"]) as workers:
        tally = played(tmp_path, workers, 12, Trouble({3: "broken once"}, seconds=0.05))
    assert tally.made == 12 and tally.failed == tally.lost == 0 and held(tmp_path) == undisturbed
    lines = [line.split() for line in tried(tmp_path)]
    assert {card for _, _, card in lines} == {"0", "1"}
    (first, broken), (second, fresh) = [(at, line[1]) for at, line in enumerate(lines) if line[0] == "3"]
    assert broken not in [line[1] for line in lines[first + 1 :]] and fresh != broken and second > first


def test_scheduler_rejects_clients_without_its_keys(workers):
    address = workers.client.scheduler.address
    served = workers.client.run_on_scheduler(lambda dask_scheduler: dask_scheduler.http_server.port)
    assert address.startswith("tls://")
    for security in (Security(), Security.temporary()):
        plain = address if security.tls_ca_file else address.replace("tls", "tcp")
        with pytest.raises((OSError, TypeError)):
            Client(plain, security=security, timeout=2.0, set_as_default=False)
    ports = [int(each.rpartition(":")[2]) for each in workers.client.scheduler_info(n_workers=-1)["workers"]]
    for port in ports:
        with pytest.raises(OSError):
            Client(f"tcp://127.0.0.1:{port}", timeout=1.0, set_as_default=False)
    for page in ("/", "/status", "/info/main/workers.html", "/json/counts.json", "/metrics"):
        with pytest.raises(HTTPError, match="404"):
            urlopen(f"http://127.0.0.1:{served}{page}", timeout=5.0)


def test_running_scheduler_accepts_more_workers_and_may_stop(undisturbed, tmp_path):
    address = "tcp://127.0.0.1:9"
    with pytest.raises(InputError, match=f"--scheduler {address}: no Dask scheduler at this address"):
        connect_workers(address, "cpu", timeout=0.5).__enter__()
    counts, added = [], []
    with ExitStack() as closing:
        own = closing.enter_context(SpecCluster({}, {"cls": Scheduler, "options": {"host": "127.0.0.1", "port": 0}}))
        address = own.scheduler_address
        command = [sys.executable, "-m", "dask", "worker", address, "--nthreads", "1", "--host", "127.0.0.1"]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}

        def add():
            quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
            added.append(closing.enter_context(subprocess.Popen(command, env=environment, cwd=tmp_path, **quiet)))
            closing.callback(added[-1].terminate)

        def heard(kind, outcome, count):
            if len(added) < 2:
                add()
            counts.append(count)

        add()
        with connect_workers(address, "auto") as workers:
            assert workers.device == "cpu"
            folder = tmp_path / "more"
            assert played(folder, workers, 30, Trouble(seconds=0.2), heard).made == 30
        assert max(counts) == 2 and len({line.split()[1] for line in tried(folder)}) == 2
        assert {name: held(folder)[name] for name in undisturbed} == undisturbed

        def ending(kind, outcome, count):
            own.close()

        folder = tmp_path / "ended"
        ended = pytest.raises(InputError, match="scheduler ended")
        with connect_workers(address, "cpu", timeout=0.5) as workers, ended:
            played(folder, workers, 30, Trouble(seconds=0.1), ending)


def test_run_folder_rejects_a_run_with_other_settings(tmp_path):
    folder = tmp_path / "new"
    assert begin_run(folder, tiny_run(), PLAN) and not begin_run(folder, tiny_run(), PLAN)
    for changed, words in (
        ({"digest": "other"}, "of another text or other anatomies of the plan tiny"),
        ({"seed": 2}, "Give --seed 1"),
        ({"device": "cuda"}, "Give --device cpu"),
        ({"versions": {**tiny_run().versions, "numpy": "3.0"}}, r"numpy .* and not 3\.0.*--force"),
    ):
        with pytest.raises(InputError, match=words):
            begin_run(folder, tiny_run(**changed), PLAN)
    assert read_run(folder) == tiny_run()
    newer = tiny_run(versions={**tiny_run().versions, "numpy": "3.0"})
    assert not begin_run(folder, newer, PLAN, force=True) and read_run(folder) == newer
    (tmp_path / "mine.txt").write_text("mine")
    shutil.rmtree(folder)
    with pytest.raises(InputError, match=r"holds mine\.txt, and no run was begun"):
        begin_run(tmp_path, tiny_run(), PLAN)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
    assert begin_run(tmp_path, tiny_run(), PLAN, force=True)
    (tmp_path / "run.json").write_text("mine")
    with pytest.raises(InputError, match="is not what `sulcus episodes` writes"):
        begin_run(tmp_path, tiny_run(), PLAN)


def test_missing_episodes_are_found_by_file_name(tmp_path):
    for number in (1, 3, 1234567):
        (tmp_path / f"episode_{number:06d}.h5").touch()
    (tmp_path / ".sulcus-0-0-episode_000002.h5").touch()
    assert list_missing_episodes(tmp_path, list_finished(tmp_path), range(5), True) == (
        RunStatistics(skipped=2),
        [0, 2, 4],
    )
    assert list_missing_episodes(tmp_path, list_finished(tmp_path), range(1234567, 1234568), True)[1] == []
    there, shuffled = list_missing_episodes(tmp_path, list_finished(tmp_path), range(100, 200), False)
    assert sorted(shuffled) == list(range(100, 200)) != shuffled and there == RunStatistics()
    assert not to_body_path(tmp_path, 0).exists()


def test_failed_episodes_are_listed_by_file_name_only(tmp_path, monkeypatch):
    for number in (3, 5):
        mark_failed(tmp_path, Failure(number, f"no {number}", lost=False))
    assert list_failed(tmp_path) == {3, 5} and read_failure(tmp_path, 5) == Failure(5, "no 5", lost=False)
    assert read_failure(tmp_path, 4) is None
    monkeypatch.setattr(Path, "read_text", lambda *given: pytest.fail("a file was read"))
    assert list_failed(tmp_path) == {3, 5} and list_missing_episodes(tmp_path, set(), range(4), True, with_failed=True)[
        1
    ] == [0, 1, 2, 3]
