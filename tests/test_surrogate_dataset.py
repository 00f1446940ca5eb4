"""Data sets: resuming after a kill, no mixed parameters, and marked failed cases."""

import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from boxes import base_held, quadratic
from boxes import box as cube

from sim.deformation import Outcome
from sim.errors import InputError
from sim.loads import Loads, Posture, Pushed, build_posture, push
from surrogate.data.dataset import (
    SEAL_ATTRIBUTE,
    read_dataset,
    read_embedded_anatomy,
    read_loads,
    write_embedded_anatomy,
    write_loads,
)
from surrogate.data.simulate import simulate
from surrogate.data.tool_loads import draw

SAID = {"preset": "palpation", "seed": "0"}


@pytest.fixture(scope="module")
def loads(box):
    return draw("palpation", box, 20, 0)


def test_written_dataset_is_read_unchanged(tmp_path, box, pretender, loads):
    path = tmp_path / "data.h5"
    seen = []
    said = simulate(path, pretender, loads, SAID, 8, lambda done, total: seen.append((done, total)))
    data = read_dataset(path)
    units = 3 * int(box.craniotomy.sum())
    solved = said.total
    assert (said.load_count, said.unit_count) == (len(loads), units) and min(said.unit_seconds, said.load_seconds) > 0.0
    assert solved == len(loads) + units and seen[-1] == (solved, solved) and not list(tmp_path.glob("*.partial"))
    assert data.anatomy.digest == box.digest and data.provenance["preset"] == "palpation"
    assert np.array_equal(data.loads.get(Pushed).force, loads.get(Pushed).force)
    whole = pretender.deform(loads).displacement
    assert np.allclose(data.read_displacement(np.arange(len(box.mesh.nodes))), whole, rtol=0, atol=1e-7 * whole.max())
    assert np.array_equal(
        data.read_displacement(box.tumour_nodes), data.read_displacement(slice(None))[:, box.tumour_nodes]
    )
    assert data.read_displacement(box.tumour_nodes).dtype == np.float32
    assert data.good.all() and (data.iterations == 4).all() and (data.residual == 1e-5).all()


def test_posture_loads_round_trip_through_the_file(tmp_path):
    both = Loads(
        (*push(np.zeros(3), np.ones((2, 3)), 0.01).causes, *build_posture([[0.0, -1.0, 0.0]], [0.01, 0.02]).causes)
    )
    with h5py.File(tmp_path / "data.h5", "w") as file:
        write_loads(file, both)
        read = read_loads(file)
    assert [type(cause) for cause in read.causes] == [Pushed, Posture]
    for name, array in vars(both.get(Posture)).items():
        assert np.array_equal(getattr(read.get(Posture), name), array)


@pytest.mark.parametrize("mesh", [cube((2, 2, 2)), quadratic(cube((2, 2, 2)), curved=0.05)], ids=["p1", "p2"])
def test_anatomy_is_embedded_in_the_dataset(tmp_path, mesh):
    with h5py.File(tmp_path / "data.h5", "w") as file:
        write_embedded_anatomy(file, base_held(mesh))
        assert read_embedded_anatomy(file).digest == base_held(mesh).digest


def test_unit_responses_superpose_to_small_loads(tmp_path, box, pretender, loads):
    from surrogate.data.cortex_patch import open_patch
    from surrogate.data.encode import compute_unit_nodal_forces

    simulate(tmp_path / "data.h5", pretender, loads, SAID)
    small = loads.scale(1e-4)
    table = read_dataset(tmp_path / "data.h5").compute_unit_response(box.tumour_nodes)
    shares = compute_unit_nodal_forces(open_patch(box), small.get(Pushed))
    size = np.linalg.norm(small.get(Pushed).force, axis=1)
    predicted = size[:, None, None] * np.einsum("bf,fni->bni", shares, table)
    truth = pretender.deform(small, at=box.tumour_nodes).displacement
    assert np.linalg.norm(predicted - truth) < 1e-3 * np.linalg.norm(truth)


def test_failed_cases_are_stored_with_their_outcome(tmp_path, pretender, loads):
    size = np.linalg.norm(loads.get(Pushed).force, axis=1)
    limit = np.median(size)
    simulate(tmp_path / "data.h5", type(pretender)(pretender.anatomy, limit), loads, SAID)
    data = read_dataset(tmp_path / "data.h5")
    assert np.array_equal(data.good, size <= limit) and 0 < data.good.sum() < len(loads)
    assert data.outcome[int(size.argmax())] is Outcome.BUDGET and data.iterations.max() == 60
    assert (np.abs(data.read_displacement(slice(None))).max(axis=(1, 2)) > 0).all()


def unfinished(folder, pretender, loads, path="data.h5"):
    """A run that was stopped before its last batch."""

    class StopError(Exception):
        pass

    def stop(done, total):
        if done > total - 8:
            raise StopError

    with pytest.raises(StopError):
        simulate(folder / path, pretender, loads, SAID, 8, stop)
    return folder / path


KILLED = """
import glob, os, runpy, signal, sys
import h5py
tools = runpy.run_path(sys.argv[1])
box = tools["make_box"]()
from sim.runtime import journal
from surrogate.data.tool_loads import draw
from surrogate.data.simulate import simulate
path, kind, last, count = sys.argv[2], sys.argv[3], int(sys.argv[4]), 0
def dying(*given):
    global count
    count += 1
    if count == last and kind == "torn":
        (file,) = glob.glob(os.path.join(os.path.dirname(path), "*.partial"))
        size = os.path.getsize(file)
        before(*given)
        os.truncate(file, size + 1000)
    if count == last:
        os.kill(os.getpid(), signal.SIGKILL)
    return before(*given)
owner, name = (h5py.Dataset, "__setitem__") if kind == "file" else (journal.Journal, "add")
before = getattr(owner, name)
setattr(owner, name, dying)
simulate(path, tools["Pretender"](box), draw("palpation", box, 20, 0), {"preset": "palpation", "seed": "0"}, 8)
"""


def undated(path):
    """The bytes of a data set, but for its date, the seconds that solves took, and the hash of these."""
    with h5py.File(path) as file:
        dates = [file.attrs[name].encode() for name in ("date", SEAL_ATTRIBUTE)]
        times = [file.attrs[f"seconds a {each}"].encode() for each in ("load", "unit response")]
    raw = path.read_bytes()
    assert all(raw.count(date) == 1 for date in dates) and all(len(time) == 9 for time in times)
    for text in (*dates, *times):
        raw = raw.replace(text, b"")
    return raw


def test_killed_run_resumes_to_an_identical_file(tmp_path, pretender, loads):
    whole, killed = tmp_path / "whole.h5", tmp_path / "killed.h5"
    simulate(whole, pretender, loads, SAID, 8)
    # Before the first batch; in the middle of one of unit responses, and one of answers; while the file is written.
    deaths = [("clean", 1), ("torn", 3), ("torn", 22), ("file", 9)]
    for kind, number in deaths:
        words = [str(Path(__file__).with_name("conftest.py")), str(killed), kind, str(number)]
        command = [sys.executable, "-c", KILLED, *words]
        assert subprocess.run(command, cwd=tmp_path, check=False, capture_output=True).returncode == -9
        assert not killed.exists()
    with pytest.raises(InputError, match="unfinished run"):
        read_dataset(killed)
    assert [path.name.startswith(".sulcus-") for path in sorted(tmp_path.iterdir())] == [True, False, False]
    assert simulate(killed, pretender, loads, SAID, 8).total == 0
    assert read_dataset(killed).estimate_seconds("unit response", 3) is None  # none was solved by the run that ended
    assert sorted(tmp_path.iterdir()) == [killed, whole] and undated(killed) == undated(whole)


def test_finished_dataset_is_unchanged_or_extended(tmp_path, box, pretender, loads):
    path, direct = tmp_path / "data.h5", tmp_path / "direct.h5"
    simulate(path, pretender, loads, SAID, 8)
    before = path.read_bytes()
    assert simulate(path, pretender, loads, SAID, 8).total == 0 and path.read_bytes() == before
    more = draw("palpation", box, 30, 0)
    assert simulate(path, pretender, more, SAID, 8).total == 30 - 16  # the last, short batch is solved again
    simulate(direct, pretender, more, SAID, 8)
    assert undated(path) == undated(direct)
    assert (
        read_dataset(path).estimate_seconds("load", 30) > 0.0
        and read_dataset(path).estimate_seconds("unit response", 1) > 0.0
    )
    after = path.read_bytes()
    assert simulate(path, pretender, loads, SAID, 8).total == 0 and path.read_bytes() == after


def test_finished_dataset_rejects_other_parameters(tmp_path, box, pretender, loads):
    path = tmp_path / "data.h5"
    simulate(path, pretender, loads, SAID, 8)
    with pytest.raises(InputError, match="preset palpation, but now preset is mixed"):
        simulate(path, pretender, loads, {**SAID, "preset": "mixed"}, 8)
    with pytest.raises(InputError, match="batch 8"):
        simulate(path, pretender, loads, SAID, 16)
    with pytest.raises(InputError, match="other loads"):
        simulate(path, pretender, draw("palpation", box, 20, 1), SAID, 8)


def test_unfinished_dataset_rejects_other_loads(tmp_path, box, pretender, loads):
    path = unfinished(tmp_path, pretender, loads)
    with pytest.raises(InputError, match=r"number of loads 20, but now number of loads is 30.*delete it"):
        simulate(path, pretender, draw("palpation", box, 30, 0), SAID, 8)
    with pytest.raises(InputError, match="hash of the loads"):
        simulate(path, pretender, draw("palpation", box, 20, 1), SAID, 8)
    with pytest.raises(InputError, match="preset palpation, but now preset is mixed"):
        simulate(path, pretender, loads, {**SAID, "preset": "mixed"}, 8)


def test_invalid_dataset_files_are_rejected(tmp_path, pretender, loads):
    with pytest.raises(InputError, match="no such file"):
        read_dataset(tmp_path / "none.h5")
    (tmp_path / "text.h5").write_text("not HDF5")
    with pytest.raises(InputError, match="cannot be read"):
        read_dataset(tmp_path / "text.h5")
    with pytest.raises(InputError, match=r"text.h5: cannot be read as a data set.*Delete it"):
        simulate(tmp_path / "text.h5", pretender, loads, SAID)
    h5py.File(tmp_path / "other.h5", "w").close()
    with pytest.raises(InputError, match="not a data set"):
        read_dataset(tmp_path / "other.h5")
    with pytest.raises(InputError, match="--batch"):
        simulate(tmp_path / "data.h5", pretender, loads, SAID, 0)
