"""Data sets: nothing is lost to a kill, nothing is mixed, failed cases stay."""

import shutil
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
from sim.loads import Loads, Posture, Pushed, posture, push
from surrogate.dataset import read_dataset, read_embedded, read_loads, write_embedded, write_loads
from surrogate.sampling import draw
from surrogate.simulate import simulate

SAID = {"preset": "palpation", "seed": "0"}


@pytest.fixture(scope="module")
def loads(box):
    return draw("palpation", box, 20, 0)


def test_what_is_written_is_read(tmp_path, box, pretender, loads):
    path = tmp_path / "data.h5"
    seen = []
    said = simulate(path, pretender, loads, SAID, 8, lambda done, total: seen.append((done, total)))
    data = read_dataset(path)
    units = 3 * int(box.craniotomy.sum())
    solved = said.rows
    assert (said.loads, said.units) == (len(loads), units) and min(said.unit_seconds, said.load_seconds) > 0.0
    assert solved == len(loads) + units and seen[-1] == (solved, solved) and not list(tmp_path.glob("*.partial"))
    assert data.anatomy.digest == box.digest and data.provenance["preset"] == "palpation"
    assert np.array_equal(data.loads.of(Pushed).force, loads.of(Pushed).force)
    whole = pretender.deform(loads).displacement
    assert np.allclose(data.displacement(np.arange(len(box.mesh.nodes))), whole, rtol=0, atol=1e-7 * whole.max())
    assert np.array_equal(data.displacement(box.tumour_nodes), data.displacement(slice(None))[:, box.tumour_nodes])
    assert data.displacement(box.tumour_nodes).dtype == np.float32
    assert data.good.all() and (data.iterations == 4).all() and (data.residual == 1e-5).all()


def test_postures_are_stored(tmp_path):
    both = Loads((*push(np.zeros(3), np.ones((2, 3)), 0.01).causes, *posture([[0.0, -1.0, 0.0]], [0.01, 0.02]).causes))
    with h5py.File(tmp_path / "data.h5", "w") as file:
        write_loads(file, both)
        read = read_loads(file)
    assert [type(cause) for cause in read.causes] == [Pushed, Posture]
    for name, array in vars(both.of(Posture)).items():
        assert np.array_equal(getattr(read.of(Posture), name), array)


@pytest.mark.parametrize("mesh", [cube((2, 2, 2)), quadratic(cube((2, 2, 2)), curved=0.05)], ids=["p1", "p2"])
def test_the_body_travels_with_its_data(tmp_path, mesh):
    with h5py.File(tmp_path / "data.h5", "w") as file:
        write_embedded(file, base_held(mesh))
        assert read_embedded(file).digest == base_held(mesh).digest


def test_unit_responses_superpose_to_small_loads(tmp_path, box, pretender, loads):
    from surrogate.encode import nodal_shares
    from surrogate.patch import open_patch

    simulate(tmp_path / "data.h5", pretender, loads, SAID)
    small = loads.scaled(1e-4)
    table = read_dataset(tmp_path / "data.h5").unit_response(box.tumour_nodes)
    shares = nodal_shares(open_patch(box), small.of(Pushed))
    size = np.linalg.norm(small.of(Pushed).force, axis=1)
    predicted = size[:, None, None] * np.einsum("bf,fni->bni", shares, table)
    truth = pretender.deform(small, at=box.tumour_nodes).displacement
    assert np.linalg.norm(predicted - truth) < 1e-3 * np.linalg.norm(truth)


def test_failed_cases_stay_marked(tmp_path, pretender, loads):
    size = np.linalg.norm(loads.of(Pushed).force, axis=1)
    limit = np.median(size)
    simulate(tmp_path / "data.h5", type(pretender)(pretender.anatomy, limit), loads, SAID)
    data = read_dataset(tmp_path / "data.h5")
    assert np.array_equal(data.good, size <= limit) and 0 < data.good.sum() < len(loads)
    assert data.outcome[int(size.argmax())] is Outcome.BUDGET and data.iterations.max() == 60
    assert (np.abs(data.displacement(slice(None))).max(axis=(1, 2)) > 0).all()


KILLED = """
import os, runpy, signal, sys
import h5py
tools = runpy.run_path(sys.argv[1])
box = tools["make_box"]()
from surrogate.sampling import draw
from surrogate.simulate import simulate
path, last, writes = sys.argv[2], int(sys.argv[3]), 0
write = h5py.Dataset.__setitem__
def dying(self, rows, values):
    global writes
    write(self, rows, values)
    writes += 1
    if writes == last:
        os.kill(os.getpid(), signal.SIGKILL)
h5py.Dataset.__setitem__ = dying
simulate(path, tools["Pretender"](box), draw("palpation", box, 20, 0), {"preset": "palpation", "seed": "0"}, 8)
"""


def test_a_killed_run_ends_with_the_bytes_of_an_uninterrupted_one(tmp_path, pretender, loads):
    whole, killed = tmp_path / "whole.h5", tmp_path / "killed.h5"
    simulate(whole, pretender, loads, SAID, 8)
    # In the layout; between the columns of a unit batch; before its flag; in a batch of answers.
    deaths = [7, 17, 19, 103]
    for writes in deaths:
        command = [sys.executable, "-c", KILLED, str(Path(__file__).with_name("conftest.py")), str(killed), str(writes)]
        assert subprocess.run(command, cwd=tmp_path, check=False, capture_output=True).returncode == -9
        assert not killed.exists()
    with pytest.raises(InputError, match="unfinished run"):
        read_dataset(killed)
    solved = simulate(killed, pretender, loads, SAID, 8).rows
    assert 0 < solved < len(loads) + 3 * int(pretender.anatomy.craniotomy.sum())
    assert killed.read_bytes() == whole.read_bytes()


def test_a_finished_file_is_left_alone_and_extended(tmp_path, box, pretender, loads):
    path, direct = tmp_path / "data.h5", tmp_path / "direct.h5"
    simulate(path, pretender, loads, SAID, 8)
    before = path.read_bytes()
    assert simulate(path, pretender, loads, SAID, 8).rows == 0 and path.read_bytes() == before
    more = draw("palpation", box, 30, 0)
    assert simulate(path, pretender, more, SAID, 8).rows == 30 - 16  # the last, short batch is solved again
    simulate(direct, pretender, more, SAID, 8)
    assert path.read_bytes() == direct.read_bytes()
    assert simulate(path, pretender, loads, SAID, 8).rows == 0 and path.read_bytes() == direct.read_bytes()


def test_other_parameters_are_refused(tmp_path, box, pretender, loads):
    path = tmp_path / "data.h5"
    simulate(path, pretender, loads, SAID, 8)
    with pytest.raises(InputError, match="preset palpation, but now preset is mixed"):
        simulate(path, pretender, loads, {**SAID, "preset": "mixed"}, 8)
    with pytest.raises(InputError, match="batch 8"):
        simulate(path, pretender, loads, SAID, 16)
    with pytest.raises(InputError, match="other loads"):
        simulate(path, pretender, draw("palpation", box, 20, 1), SAID, 8)
    shutil.move(path, tmp_path / "data.h5.partial")
    with pytest.raises(InputError, match="begun for 20 loads"):
        simulate(path, pretender, draw("palpation", box, 30, 0), SAID, 8)


def test_bad_files_are_sentences(tmp_path, pretender, loads):
    with pytest.raises(InputError, match="no such file"):
        read_dataset(tmp_path / "none.h5")
    (tmp_path / "text.h5").write_text("not HDF5")
    with pytest.raises(InputError, match="cannot be read"):
        read_dataset(tmp_path / "text.h5")
    with pytest.raises(InputError, match=r"cannot be written"):
        simulate(tmp_path / "text.h5", pretender, loads, SAID)
    h5py.File(tmp_path / "other.h5", "w").close()
    with pytest.raises(InputError, match="not a data set"):
        read_dataset(tmp_path / "other.h5")
    with pytest.raises(InputError, match="--batch"):
        simulate(tmp_path / "data.h5", pretender, loads, SAID, 0)
