"""Data sets of several devices: equal bytes, killed processes, and commands."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
import warp as wp
from on_devices import gone, small_body

from scenes.cli import main
from sim.accuracy import TRAIN
from sim.bodies.meshfile import write_anatomy
from sim.effects import NodalForce, build_push_effects
from sim.errors import InputError
from sim.material import BRAIN
from surrogate.data.dataset import SEAL_ATTRIBUTE, read_dataset
from surrogate.data.simulate import simulate
from surrogate.data.solver_pool import LazyFem, choose_even_batch, open_solvers
from surrogate.data.tool_loads import draw

SAID = {"preset": "palpation", "seed": "0"}
COUNT = 20


@pytest.fixture(scope="module")
def body():
    return small_body()


@pytest.fixture(scope="module")
def box_file(tmp_path_factory, body):
    path = tmp_path_factory.mktemp("devices") / "box.vtu"
    write_anatomy(path, body)
    return str(path)


def undated(path):
    """The bytes of a data set, but for its date, the seconds that solves took, and the hash of these."""
    with h5py.File(path) as file:
        names = ("date", SEAL_ATTRIBUTE, "seconds a load", "seconds a unit response")
        texts = {file.attrs[name].encode() for name in names}
    raw = path.read_bytes()
    for text in texts:
        assert text in raw
        raw = raw.replace(text, b"")
    return raw


@pytest.mark.parametrize("batch", [1, 8])
def test_dataset_is_independent_of_device_count(tmp_path, body, batch):
    effects, loads = (*build_push_effects(body, BRAIN), NodalForce()), draw("palpation", body, COUNT, 0)
    counts = []
    for devices in (["cpu"], ["cpu", "cpu"]):
        with open_solvers(LazyFem(body, effects, TRAIN, "smoothed", batch, COUNT), devices, print) as solver:
            assert (solver.element, solver.batch_size) == ("smoothed", batch)
            seen = []
            path = tmp_path / f"{len(devices)}.h5"
            said = simulate(path, solver.deformer, loads, SAID, batch, lambda *done, seen=seen: seen.append(done))
            counts.append((said.unit_count, said.load_count, len(seen), seen[0], seen[-1]))
            assert said.load_seconds > 0.0
    assert counts[0] == counts[1] and counts[0][:2] == (3 * int(body.craniotomy.sum()), COUNT)
    assert undated(tmp_path / "1.h5") == undated(tmp_path / "2.h5")
    assert read_dataset(tmp_path / "2.h5").good.all()


@pytest.mark.gpu
@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device here")
def test_two_processes_on_one_gpu_match_one_process(tmp_path, body):
    """Within the tolerance: GPU sums have no fixed order, and one process does not repeat its last bits either."""
    effects, loads = (*build_push_effects(body, BRAIN), NodalForce()), draw("palpation", body, 64, 0)
    found = []
    for devices in (["cuda:0"], ["cuda:0", "cuda:0"]):
        with open_solvers(LazyFem(body, effects, TRAIN, None, 8, 64), devices, print) as solver:
            simulate(tmp_path / f"{len(devices)}.h5", solver.deformer, loads, SAID, 8)
        found.append(read_dataset(tmp_path / f"{len(devices)}.h5"))
    every = np.arange(len(body.mesh.nodes))
    one, two = (data.read_displacement(every) for data in found)
    assert all(data.good.all() for data in found) and np.abs(one - two).max() <= 2e-3 * np.abs(one).max()
    units = [data.compute_unit_response(every) for data in found]
    assert np.abs(units[0] - units[1]).max() <= 2e-3 * np.abs(units[0]).max()


@pytest.mark.parametrize("devices", [("cpu",), ("cpu", "cpu")])
def test_batch_above_memory_limit_is_rejected_before_start(body, devices):
    """A file keeps its batch size, and would reject a smaller one later."""
    asked = LazyFem(body, (*build_push_effects(body, BRAIN), NodalForce()), TRAIN, "p1", 10**9, 2 * 10**9)
    refused = pytest.raises(InputError, match=r"the results of 1000000000 loads take about .* are free: solve at most")
    with refused, open_solvers(asked, devices, print):
        pytest.fail("it would begin")


def test_batch_size_is_divided_evenly_among_devices():
    assert [choose_even_batch(10_000, count, 4) for count in (5, 5_000, 40_000, 50_000)] == [2, 1_250, 10_000, 6_250]
    assert choose_even_batch(0, 7, 2) == 1 and choose_even_batch(64, 7, 1) == 7


def test_run_resumes_on_other_devices_in_same_batches(tmp_path, box_file, capsys):
    """A run keeps its batch size unless another one is requested."""
    words = ["simulate", box_file, "--out", str(tmp_path / "a.h5"), "--json"]
    assert main([*words, "--count", "12", "--batch", "5", "--device", "cpu,cpu"]) == 0
    assert main([*words, "--count", "20", "--device", "cpu"]) == 0
    said = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [each["loads"] for each in said] == [12, 20] and said[1]["solved_now"] == 10
    with h5py.File(tmp_path / "a.h5") as file:
        assert (file.attrs["batch"], file.attrs["device"]) == ("5", "cpu")
    assert main([*words, "--count", "20", "--batch", "6", "--device", "cpu"]) == 2
    assert "was made with batch 5, but now batch is 6" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["simulate", "BOX", "--out", "a.h5", "--device", "cpu,tpu"], "no device 'tpu'"),
        (["simulate", "BOX", "--out", "a.h5", "--device", "cpu,cpu", "--batch", "0"], "batch is 0"),
        (
            ["demo", "--anatomy", "BOX", "--device", "cpu,cpu"],
            "'cpu,cpu' names several devices, but only one is allowed here",
        ),
    ],
)
def test_invalid_device_lists_are_rejected(tmp_path, box_file, capsys, monkeypatch, words, reason):
    monkeypatch.chdir(tmp_path)
    assert main([box_file if word == "BOX" else word for word in words]) == 2
    assert reason in capsys.readouterr().err and not list(tmp_path.iterdir())


def children_of(parent):
    """The processes of which it is the parent."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            parts = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(parts[1]) == parent and parts[0] != "Z":
            found.append(int(path.parent.name))
    return found


def test_interrupt_ends_all_processes_with_a_resume_message(tmp_path, box_file):
    """Signal to the whole process group, as by a terminal; the only message says how to resume."""
    command = [sys.executable, "-m", "scenes.cli", "simulate", box_file, "--out", str(tmp_path / "a.h5")]
    command += ["--count", "5000", "--batch", "4", "--device", "cpu,cpu", "--json"]
    root = Path(__file__).parents[1]
    run = subprocess.Popen(
        command,
        cwd=root,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(root)},
    )
    partial = tmp_path / "a.h5.partial"
    try:
        while run.poll() is None and not (partial.exists() and partial.stat().st_size > 300_000):
            time.sleep(0.1)
        children = children_of(run.pid)
        assert len(children) >= 2
        os.killpg(run.pid, signal.SIGINT)
        out, error = run.communicate(timeout=30)
    finally:
        run.kill()
    assert run.returncode in (130, -signal.SIGINT) and out == ""
    assert error.strip().endswith(f"stopped; run the same command again to resume from {tmp_path / 'a.h5'}.partial")
    assert "Traceback" not in error and "Interrupt" not in error
    assert all(map(gone, children))
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5.partial"]
