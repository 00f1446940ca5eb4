"""Killed processes: no finished episode is lost or made twice, and no partial file looks complete."""

import os
import random
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import h5py
import pytest
from tiny_work import held, played

from scenes.episodes.run_folder import list_failures
from scenes.episodes.workers import start_local_workers

COUNT, KILLS = 80, 50
CLIENT = """
import sys
from pathlib import Path
from scenes.episodes.workers import start_local_workers
from tiny_work import Trouble, played

if __name__ == "__main__":
    with start_local_workers(["cpu"] * 3, {"distributed.scheduler.allowed-failures": 1000}, 1000) as workers:
        played(Path(sys.argv[1]), workers, int(sys.argv[2]), Trouble(seconds=0.2))
"""


def started(script, folder):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, str(script), str(folder), str(COUNT)]
    return subprocess.Popen(command, env=environment, start_new_session=True)


def processes_of(client):
    """The workers of a client: its children that were spawned."""
    found = []
    with suppress(OSError):
        for task in Path(f"/proc/{client.pid}/task").glob("*/children"):
            found += [int(number) for number in task.read_text().split()]
        return [one for one in found if b"spawn_main" in Path(f"/proc/{one}/cmdline").read_bytes()]
    return []


def alive(group):
    """Whether a process of this group runs; one that has ended may wait long to be reaped."""
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, _, its_group = path.read_text().rpartition(")")[2].split()[:3]
            if int(its_group) == group and state != "Z":
                return True
    return False


def awaited(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def ended(client, all_at_once):
    if all_at_once:
        os.killpg(client.pid, signal.SIGKILL)
    client.kill()
    client.wait()
    awaited(lambda: not alive(client.pid), 20)  # its workers notice that it is gone


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds children by the system's table of processes")
def test_fifty_killed_processes_lose_or_repeat_no_episode(tmp_path):
    script, folder = tmp_path / "client.py", tmp_path / "killed"
    script.write_text(CLIENT)
    chance, kills = random.Random(0), {"worker": 0, "client": 0}
    client = started(script, folder)
    seen = {}
    try:
        while sum(kills.values()) < KILLS:
            awaited(lambda: processes_of(client))  # noqa: B023
            if chance.random() < 0.2:
                awaited(lambda: len(list(folder.glob("episode_*.h5"))) > len(seen))  # noqa: B023
            time.sleep(chance.uniform(0.0, 0.05))
            seen_now = {path.name: path.stat().st_ino for path in folder.glob("episode_*.h5")}
            assert seen.items() <= seen_now.items()  # what was there is there, and is the same file
            seen = seen_now
            for path in random.sample(sorted(folder.glob("episode_*.h5")), min(3, len(seen))):
                with h5py.File(path) as file:
                    assert len(file) == 3
            workers = processes_of(client)
            assert client.poll() is None
            if sum(kills.values()) % 10 == 9:
                ended(client, chance.random() < 0.7)
                kills["client"] += 1
                client = started(script, folder)
            elif workers:
                with suppress(ProcessLookupError):
                    os.kill(chance.choice(workers), signal.SIGKILL)
                    kills["worker"] += 1
    finally:
        ended(client, False)
    assert kills == {"worker": 45, "client": 5} and COUNT > len(seen) > 5
    whole = tmp_path / "undisturbed"
    with start_local_workers(["cpu"]) as workers:
        tally = played(folder, workers, COUNT)
        assert tally.made + tally.skipped == COUNT and tally.skipped >= len(seen) and not list_failures(folder)
        assert played(whole, workers, COUNT).made == COUNT
    assert held(folder) == held(whole) and len(held(folder)) == COUNT
    made = {path.name for path in whole.iterdir()}
    assert {path.name for path in folder.iterdir()} == made  # nothing unfinished is left
