"""Two machines that share one folder, one of them disconnected and killed: no episode is lost or made twice.

Each is a network, a host name and a table of processes of its own (namespaces of Linux), on one kernel and one disk.
"""

import os
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager

import pytest
from conftest import make_box

from scenes.episodes.rates import read_rates
from scenes.episodes.run_folder import list_failed, list_finished
from sim.bodies.meshfile import write_anatomy

pytestmark = pytest.mark.skipif(
    "SULCUS_TWO_MACHINES" not in os.environ, reason="needs SULCUS_TWO_MACHINES, and root's right to make networks"
)
COUNT = 80
ADDRESS = {"lan": "10.77.0.1", "one": "10.77.0.2", "two": "10.77.0.3"}
SCHEDULER = f"tcp://{ADDRESS['lan']}:8786"
PLAN = """
title = "A box"
seconds = [0.5, 1.0]
frames_per_second = 10.0
size = [160, 120]
solved_every = 3
[motion.press]
force_n = [0.05, 0.1]
[bodies]
count = 2
anatomies = "box.vtu"
[bodies.learner]
name = "linear"
loads = 60
"""


def ip(*words):
    """Give one command of iproute2."""
    subprocess.run(["ip", *words], check=True)


@pytest.fixture
def network():
    """A switch, and two machines that are plugged into it; gives what is said before their names."""
    head = f"sulcus-{os.getpid()}-"
    with ExitStack() as closing:
        for name in ADDRESS:
            ip("netns", "add", head + name)
            closing.callback(ip, "netns", "del", head + name)
            ip("-n", head + name, "link", "set", "lo", "up")
        lan = head + "lan"
        ip("-n", lan, "link", "add", "name", "switch", "type", "bridge")
        ip("-n", lan, "link", "set", "switch", "up")
        ip("-n", lan, "addr", "add", f"{ADDRESS['lan']}/24", "dev", "switch")
        for name in ("one", "two"):
            ip("-n", lan, "link", "add", "name", name, "type", "veth", "peer", "name", "eth", "netns", head + name)
            ip("-n", lan, "link", "set", name, "master", "switch", "up")
            ip("-n", head + name, "addr", "add", f"{ADDRESS[name]}/24", "dev", "eth")
            ip("-n", head + name, "link", "set", "eth", "up")
        yield head


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plan")
    write_anatomy(folder / "box.vtu", make_box(cells=(8, 8, 5), spacing=9e-3))
    (folder / "own.toml").write_text(PLAN)
    return folder / "own.toml"


@pytest.fixture(scope="module")
def undisturbed(plan, tmp_path_factory):
    """The episodes' bytes, as one process makes them."""
    folder = tmp_path_factory.mktemp("undisturbed")
    subprocess.run([*command(plan, folder), "--workers", "1"], check=True, env=environment(), timeout=300)
    return held(folder)


def command(plan, folder):
    words = ["episodes", str(plan), "--count", str(COUNT), "--seed", "1", "--device", "cpu", "--out", str(folder)]
    return [sys.executable, "-m", "scenes.cli", *words]


def environment():
    path = os.pathsep.join(filter(None, sys.path))
    return {**os.environ, "PYTHONPATH": path, "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "20"}


def held(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.glob("episode_*.h5"))}


@contextmanager
def machine(network, name, words, folder):
    """A machine that runs one command, and all of whose processes end with this block, or when it is killed."""
    apart = ["unshare", "--uts", "--pid", "--fork", "--kill-child", "--mount-proc"]
    inside = [*apart, "sh", "-c", f'hostname {name}; exec "$@"', "sh", *words]
    log = (folder.parent / f"{name}.txt").open("a")
    process = subprocess.Popen(
        ["ip", "netns", "exec", network + name, *inside], env=environment(), stdout=log, stderr=log, cwd=folder.parent
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        log.close()


def lose(network, name, process):
    """Unplug a machine, so that its connections end without a word, and end all that runs on it."""
    ip("-n", network + "lan", "link", "set", name, "down")
    process.kill()
    process.wait()


def awaited(condition, seconds=240):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def files(folder):
    """Which file each episode is."""
    return {path.name: path.stat().st_ino for path in folder.glob("episode_*.h5")}


def test_run_completes_after_loss_of_a_scheduled_machine(network, plan, undisturbed, tmp_path):
    folder = tmp_path / "set"
    dask = [sys.executable, "-m", "dask"]
    work = [*dask, "worker", SCHEDULER, "--nthreads", "1", "--memory-limit", "0", "--no-nanny", "--no-dashboard"]
    host = ["scheduler", "--host", ADDRESS["lan"], "--port", "8786", "--no-dashboard"]
    with ExitStack() as closing:

        def begun(name, words):
            return closing.enter_context(machine(network, name, words, folder))

        begun("lan", [*dask, *host])
        one = begun("one", [*work, "--host", ADDRESS["one"]])
        begun("two", [*work, "--host", ADDRESS["two"]])
        client = begun("lan", [*command(plan, folder), "--scheduler", SCHEDULER])
        awaited(lambda: len(list_finished(folder)) >= 8)
        lose(network, "one", one)
        before = files(folder)
        awaited(lambda: "Remove worker addr: tcp://" + ADDRESS["one"] in (tmp_path / "lan.txt").read_text())
        awaited(lambda: len(list_finished(folder)) >= len(before) + 5)  # the other goes on
        ip("-n", network + "lan", "link", "set", "one", "up")
        begun("one", [*work, "--host", ADDRESS["one"]])
        assert client.wait(timeout=240) == 0
    assert held(folder) == undisturbed and before.items() <= files(folder).items() and not list_failed(folder)
    numbers = [rate.number for rate in read_rates(folder) if rate.kind == "episode"]
    assert len(set(numbers)) == len(numbers) <= COUNT


def test_independent_machines_share_one_episode_folder(network, plan, undisturbed, tmp_path):
    folder = tmp_path / "set"
    words = [*command(plan, folder), "--workers", "1"]
    with machine(network, "one", words, folder) as one, machine(network, "two", words, folder) as two:
        awaited(lambda: len(list_finished(folder)) >= 8)
        lose(network, "one", one)
        before = files(folder)
        assert two.wait(timeout=240) == 0
    assert held(folder) == undisturbed and before.items() <= files(folder).items() and not list_failed(folder)
    with machine(network, "one", words, folder) as one:  # as it comes again, there is nothing left to do
        assert one.wait(timeout=120) == 0
    assert before.items() <= files(folder).items() and held(folder) == undisturbed
    assert "0 were made now" in (folder.parent / "one.txt").read_text()
    twice = [rate.number for rate in read_rates(folder) if rate.kind == "episode"]
    assert len(twice) - len(set(twice)) <= 2  # a coincidence, which its two makers wrote alike
