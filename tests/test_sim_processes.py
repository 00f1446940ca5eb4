"""Lists of devices, and a process on each: tasks and results, lost processes, and their end with the parent."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import warp as wp
from on_devices import doing, gone, named, refusing

from sim.errors import InputError
from sim.runtime.device import find_device, parse_device_names
from sim.runtime.processes import LostProcessError, map_unordered, process_pool, run_on_each

NO_CARD = pytest.mark.skipif(wp.is_cuda_available(), reason="there is a card here")


@pytest.mark.parametrize(("words", "names"), [("cpu", 1), ("cpu,cpu", 2), (" cpu , cpu,cpu", 3)])
def test_device_list_is_parsed_into_device_names(words, names):
    assert parse_device_names(words) == ("cpu",) * names
    assert parse_device_names("auto") == (find_device("auto", "float32").name,)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("all,cpu", "lists devices together with 'all'"),
        ("cpu,", "contains an empty device name"),
        ("", "'' names no device: choose auto, or cpu"),
        (" , ", "names no device: choose auto, or cpu"),
        ("cpu,abacus", "no device 'abacus' here: choose auto or cpu"),
        pytest.param("all", r"'all' means every GPU, and there is none.*or name devices", marks=NO_CARD),
        pytest.param("cpu,cuda:0", "no device 'cuda:0' here, as no NVIDIA driver", marks=NO_CARD),
    ],
)
def test_invalid_device_list_is_rejected(words, reason):
    with pytest.raises(InputError, match=reason):
        parse_device_names(words)


@pytest.mark.parametrize("words", ["cpu,cpu", "all", "cuda:0,cuda:1"])
def test_single_device_argument_rejects_several_devices(words):
    with pytest.raises(InputError, match=f"'{words}' names several devices, but only one is allowed here: choose"):
        find_device(words, "float32")


def test_gpus_are_listed_and_not_mixed_with_cpus(monkeypatch):
    class Card:
        def __init__(self, alias):
            self.alias = alias

    monkeypatch.setattr(wp, "get_devices", lambda: [Card(name) for name in ("cpu", "cuda:0", "cuda:1")])
    assert parse_device_names("all") == ("cuda:0", "cuda:1") == parse_device_names("cuda,cuda:1")
    assert parse_device_names("cuda:0,cuda:0") == ("cuda:0", "cuda:0")
    with pytest.raises(InputError, match="'cuda:0,cpu' mixes CPU and GPUs"):
        parse_device_names("cuda:0,cpu")


def test_every_task_is_solved_once_and_processes_end():
    with process_pool(["cpu", "cpu"], named, "a body") as children:
        found = dict(map_unordered(children, doing, range(7)))
        assert sorted(found) == list(range(7))
        assert all(answer[:2] == (("cpu", ("a body",)), task) for task, answer in found.items())
        each = run_on_each(children, doing, ["one", "other"])
        assert [answer[1] for answer in each] == ["one", "other"]
        numbers = {answer[2] for answer in each}
        assert len(numbers) == 2 and {answer[2] for answer in found.values()} <= numbers
        assert os.getpid() not in numbers
    assert all(map(gone, numbers))


def test_process_sees_only_its_own_gpu(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    with process_pool(["cpu", "cuda:0", "cuda:2"], named) as children:
        said = run_on_each(children, doing, ["environment"] * 3)
    assert said == [("cpu", ""), ("cuda:0", "0"), ("cuda:0", "2")]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "5,GPU-7")
    with process_pool(["cuda:1"], named) as children:
        assert run_on_each(children, doing, ["environment"]) == [("cuda:0", "GPU-7")]


def test_error_during_construction_in_process_is_reported():
    with pytest.raises(InputError, match="nothing is made on cpu"), process_pool(["cpu", "cpu"], refusing):
        pass


def test_error_in_process_names_its_device():
    """Errors of bad input keep their type and message."""
    with process_pool(["cpu", "cuda:0"], named) as children:
        with pytest.raises(InputError, match=r"^this is refused\.\n"):
            run_on_each(children, doing, ["refuse", 1])
        with pytest.raises(RuntimeError, match="out of memory") as failure:
            run_on_each(children, doing, ["fail", 1])
        assert "in doing" in failure.value.__notes__[0]
    with (
        process_pool(["cpu", "cuda:0"], named) as children,
        pytest.raises(
            LostProcessError, match=r"cuda:0 failed: out of memory\. If that happens again, give --device one"
        ),
    ):
        run_on_each(children, doing, [1, "fail"])


def test_results_are_returned_before_a_lost_process_is_reported():
    """One process dies and the other has finished before the next read; tasks that were not started stay so."""
    given = []
    with process_pool(["cpu", "cpu"], named) as children, pytest.raises(LostProcessError) as lost:
        for task, _ in map_unordered(children, doing, ["doze and die", 0, "nap", 9]):
            given.append(task)
            time.sleep(1.5)
    assert "the process on cpu was ended (Killed), probably out of memory" in str(lost.value)
    assert "give --device one cpu less" in str(lost.value) and given == [0, "nap"]


def test_processes_end_when_their_parent_is_killed():
    """In the middle of a task that takes minutes."""
    code = (
        "from on_devices import doing, named\n"
        "from sim.runtime.processes import run_on_each, process_pool\n"
        "if __name__ == '__main__':\n"
        "    with process_pool(['cpu', 'cpu'], named) as children:\n"
        "        print(*(child.process.pid for child in children), flush=True)\n"
        "        run_on_each(children, doing, ['sleep', 'sleep'])\n"
    )
    paths = os.pathsep.join([str(Path(__file__).parents[1]), str(Path(__file__).parent)])
    parent = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": paths}
    )
    assert parent.stdout is not None
    with parent.stdout:
        numbers = [int(word) for word in parent.stdout.readline().split()]
        assert len(numbers) == 2 and all(Path(f"/proc/{number}").exists() for number in numbers)
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    assert all(map(gone, numbers))
