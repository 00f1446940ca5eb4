"""Damaged, truncated or forged data sets: their rows are rejected with a message."""

import json
import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from boxes import base_held
from boxes import box as cube
from limits import files_below
from test_surrogate_dataset import SAID
from test_surrogate_dataset import unfinished as stopped

from scenes.cli import main
from sim.anatomy import Anatomy
from sim.bodies.meshfile import write_anatomy
from sim.effects import build_push_effects
from sim.errors import InputError
from sim.fem import Fem
from sim.geometry.tetmesh import TetMesh
from sim.loads import push
from sim.material import read_tissue_json
from sim.runtime.journal import DamageWarning
from surrogate.data.dataset import FORMAT, OLD_FORMAT, SEAL_ATTRIBUTE, read_array, read_dataset
from surrogate.data.simulate import simulate
from surrogate.data.solution_rows import compute_row_checksums, get_row_dtype
from surrogate.data.tool_loads import draw
from surrogate.training.train import train


@pytest.fixture(scope="module")
def loads(box):
    return draw("palpation", box, 20, 0)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, pretender, loads):
    path = tmp_path_factory.mktemp("whole") / "data.h5"
    simulate(path, pretender, loads, SAID, 8)
    return path


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory, pretender, loads):
    """The bytes of a run that was stopped before its last batch."""
    path = stopped(tmp_path_factory.mktemp("unfinished"), pretender, loads)
    return path.with_name("data.h5.partial").read_bytes()


def rows_in(path):
    """Every array of the answers and unit responses, and the body, by name."""
    found = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item[:]}) if isinstance(item, h5py.Dataset) else None)
    return found


def put_right(path, group):
    """Make the checksums those of the rows that are there."""
    with h5py.File(path, "r+") as file:
        columns = file[group]
        rows = np.empty(len(columns["residual"]), get_row_dtype(columns["displacement"].shape[1]))
        for name in rows.dtype.names:
            rows[name] = columns[name][:]
        columns["checksum"][:] = compute_row_checksums(rows)


class TestUnfinished:
    def test_random_damage_never_gives_wrong_results(self, tmp_path, pretender, loads, whole, unfinished):
        good = rows_in(whole)
        path = tmp_path / "data.h5"
        resumed = 0
        for seed in range(8):
            random = np.random.default_rng(seed)
            raw = np.frombuffer(unfinished, np.uint8).copy()
            # Anywhere, and in the first 20 kB, where it says what it is.
            place = random.integers(0, 20_000 if seed % 2 else len(raw), 20)
            raw[place] ^= random.integers(1, 256, 20).astype(np.uint8)
            path.with_name("data.h5.partial").write_bytes(raw.tobytes())
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DamageWarning)
                solved = simulate(path, pretender, loads, SAID, 8)
            found = rows_in(path)
            assert found.keys() == good.keys() and all(np.array_equal(found[name], good[name]) for name in good)
            resumed += 8 <= solved.total < len(loads) + len(good["unit/node"])
            path.unlink()
        assert resumed >= 4  # what was not damaged was not solved again

    def test_only_damaged_rows_are_reported_and_solved_again(self, tmp_path, pretender, loads, unfinished):
        raw = bytearray(unfinished)
        raw[raw.index(b"answers\0") + 30_000] ^= 1
        (tmp_path / "data.h5.partial").write_bytes(raw)
        with pytest.warns(DamageWarning, match="rows from 0 on of `answers`: damaged"):
            solved = simulate(tmp_path / "data.h5", pretender, loads, SAID, 8)
        assert solved.load_count == 8 + 4 and solved.unit_count == 0  # the last, short batch was never solved

    def test_damaged_file_header_loses_no_row(self, tmp_path, pretender, loads, unfinished):
        (tmp_path / "data.h5.partial").write_bytes(unfinished[:20] + b"#" + unfinished[21:])
        with pytest.warns(DamageWarning, match="its beginning: damaged"):
            assert simulate(tmp_path / "data.h5", pretender, loads, SAID, 8).total == 4

    @pytest.mark.parametrize("content", [b"", b"some text", b"\x89HDF\r\n\x1a\n" + bytes(5000), b"sulcus\r\n" * 500])
    def test_foreign_partial_file_is_rejected_and_kept(self, tmp_path, pretender, loads, content):
        partial = tmp_path / "data.h5.partial"
        partial.write_bytes(content)
        with pytest.raises(InputError, match=r"data\.h5\.partial: is not an unfinished run.*delete it"):
            simulate(tmp_path / "data.h5", pretender, loads, SAID, 8)
        assert partial.read_bytes() == content

    def test_concurrent_run_on_the_same_file_is_rejected(self, tmp_path, pretender, loads):
        def again(done, total):
            simulate(tmp_path / "data.h5", pretender, loads, SAID, 8)

        with pytest.raises(InputError, match="another run is writing it"):
            simulate(tmp_path / "data.h5", pretender, loads, SAID, 8, again)


class TestFinished:
    @pytest.mark.parametrize(
        ("name", "row", "value"),
        [
            ("answers/displacement", 17, 12345.0),
            ("answers/displacement", 3, np.nan),
            ("answers/outcome", 4, b"CONVERGED_ANEW"),
            ("unit/displacement", 30, 0.0),
            ("unit/residual", 30, 0.5),
        ],
    )
    def test_modified_rows_are_reported_and_solved_again(self, tmp_path, pretender, loads, whole, name, row, value):
        path = Path(shutil.copy(whole, tmp_path))
        with h5py.File(path, "r+") as file:
            file[name][row] = value
        group = name.split("/")[0]
        with pytest.raises(InputError, match=rf"row {row} of `{group}` are damaged"):
            data = read_dataset(path)
            (data.read_displacement if group == "answers" else data.compute_unit_response)(
                pretender.anatomy.tumour_nodes
            )
        with pytest.warns(DamageWarning, match=rf"row {row} of `{group}`: damaged"):
            solved = simulate(path, pretender, loads, SAID, 8)
        assert solved.total == (4 if row == 17 else 8)
        good, found = rows_in(whole), rows_in(path)
        assert all(np.array_equal(found[item], good[item]) for item in good)

    @pytest.mark.parametrize(
        ("change", "sentence"),
        [
            (lambda file: file["anatomy/nodes"].__setitem__(3, 0.5), "anatomy inside was changed|volume"),
            (lambda file: file["loads/Pushed/force"].__setitem__(3, 0.5), "loads inside were changed"),
            (lambda file: file.attrs.modify("preset", "mixed"), "what it states of itself was changed"),
            (lambda file: file["unit/node"].__setitem__(5, 10**6), "`unit/node` are not the open cortex's nodes"),
            (lambda file: file["answers/outcome"].__setitem__(0, b"FINE"), "damaged"),
            (lambda file: file.__delitem__("answers/residual"), "has no array `answers/residual`"),
            (lambda file: replaced(file, "answers/residual", np.full(20, b"small")), "holds .S5"),
            (lambda file: replaced(file, "answers/outcome", np.zeros(20)), "holds float64"),
            (lambda file: replaced(file, "answers/iterations", np.zeros(19, int)), "measures 19, not 20"),
            (lambda file: moved_away(file, "answers/residual"), "has no array `answers/residual`"),
            (lambda file: moved_away(file, "loads"), "has no array `loads/Pushed"),
            (lambda file: swollen(file, "answers/displacement", (10**9, 1352, 3)), "measures 1000000000"),
            (lambda file: swollen(file, "anatomy/nodes", (10**9, 3)), "declares more than such a file holds"),
        ],
    )
    def test_dataset_with_invalid_contents_is_rejected(self, tmp_path, whole, change, sentence):
        path = Path(shutil.copy(whole, tmp_path))
        with h5py.File(path, "r+") as file:
            change(file)
        with pytest.raises(InputError, match=sentence) as caught:
            read_dataset(path)
        assert str(caught.value).startswith(str(path))

    def test_array_above_the_byte_limit_is_rejected(self, whole):
        """Also an array whose length only the file determines."""
        with h5py.File(whole) as file:
            shape = read_array(file, "anatomy/nodes", "f").shape
            assert read_array(file, "anatomy/nodes", "f", shape, 10_000).nbytes > 10_000
            with pytest.raises(InputError, match=r"`anatomy/nodes` declares more than such a file holds"):
                read_array(file, "anatomy/nodes", "f", None, 10_000)

    def test_invalid_tool_in_provenance_is_rejected(self, whole):
        data = read_dataset(whole)
        for radius in ("abc", "-1", "nan"):
            with pytest.raises(InputError, match=r"data.h5: 'Ball\(radius=.*' is no tool: .* damaged: simulate again"):
                replace(data, provenance={**data.provenance, "ball": radius})

    def test_finished_files_of_previous_version_are_read(self, tmp_path, pretender, loads, whole):
        path = Path(shutil.copy(whole, tmp_path))
        with h5py.File(path, "r+") as file:
            del file.attrs[SEAL_ATTRIBUTE]
            file.attrs["format"] = OLD_FORMAT
            for group in ("unit", "answers"):
                del file[f"{group}/checksum"]
                file[f"{group}/done"] = np.ones(len(file[f"{group}/residual"]), bool)
        some = np.arange(5)
        assert np.array_equal(read_dataset(path).read_displacement(some), read_dataset(whole).read_displacement(some))
        with pytest.raises(InputError, match="of an earlier version"):
            simulate(path, pretender, loads, SAID, 8)
        with h5py.File(path, "r+") as file:
            file["answers/done"][:] = False
        with pytest.raises(InputError, match="not done"):
            read_dataset(path)


def replaced(file, name, array):
    del file[name]
    file[name] = array


def moved_away(file, name):
    """To another file, to which a link stays."""
    other = Path(file.filename).with_name("other.h5")
    with h5py.File(other, "w") as away:
        file.copy(name, away, "here")
    del file[name]
    file[name] = h5py.ExternalLink(str(other), "/here")


def swollen(file, name, shape):
    kind = file[name].dtype
    del file[name]
    file.create_dataset(name, shape, kind, chunks=(1, *shape[1:]))


@pytest.fixture(scope="module")
def enough(tmp_path_factory, pretender):
    path = tmp_path_factory.mktemp("enough") / "data.h5"
    simulate(path, pretender, draw("palpation", pretender.anatomy, 120, 0), SAID)
    assert train(read_dataset(path), ["linear"]).models
    return path


class TestTraining:
    @pytest.mark.parametrize(
        ("group", "value", "sentence"),
        [
            ("answers", np.nan, "row 7 of `answers` are damaged"),
            ("answers", 12.0, "row 7 of `answers` move by more than the body measures"),
            ("unit", np.inf, "row 7 of `unit` are damaged"),
            ("unit", 1e6, "row 7 of `unit` move by more"),
        ],
    )
    def test_training_rejects_implausible_displacements(self, tmp_path, enough, group, value, sentence):
        path = Path(shutil.copy(enough, tmp_path))
        with h5py.File(path, "r+") as file:
            file[f"{group}/displacement"][7] = value
        put_right(path, group)
        with pytest.raises(InputError, match=sentence):
            train(read_dataset(path), ["linear"])

    def test_nan_residual_of_converged_row_is_rejected(self, tmp_path, enough):
        path = Path(shutil.copy(enough, tmp_path))
        with h5py.File(path, "r+") as file:
            file["answers/residual"][2] = np.nan
        with pytest.raises(InputError, match="row 2 of `answers` converged, but to a residual that is not a number"):
            read_dataset(path)
        data = read_dataset(enough)
        with pytest.raises(InputError, match="`residual` of 3"):
            replace(data, residual=np.zeros(3))


class TestRoom:
    def test_full_disk_is_reported_before_solving(self, tmp_path, pretender, loads, monkeypatch):
        class Stingy:
            free = 1_000_000

        monkeypatch.setattr("shutil.disk_usage", lambda path: Stingy)
        with pytest.raises(InputError, match=r"needs [\d.]+ MB, and the disk has 1.0 MB left"):
            simulate(tmp_path / "data.h5", pretender, loads, SAID, 8)
        assert not list(tmp_path.iterdir())

    @pytest.mark.parametrize(
        ("size", "asked", "sentence"),
        [
            (1_000_000, True, "files are limited to 1.0 MB here"),
            (1_000_000, False, r"data\.h5\.partial: cannot be extended \(File too large\)"),
            (3_250_000, False, r"data\.h5: cannot be written \(File too large\)"),
        ],
    )
    def test_file_size_limit_is_reported_as_error(self, tmp_path, pretender, loads, monkeypatch, size, asked, sentence):
        """HDF5 aborts the process if its own write fails; Python therefore writes the file."""
        if not asked:
            monkeypatch.setattr("surrogate.data.simulate.check_disk_space", lambda *sizes: None)
        with files_below(size), pytest.raises(InputError, match=sentence):
            simulate(tmp_path / "data.h5", pretender, loads, SAID, 8)
        assert [path.name for path in tmp_path.iterdir()] == ([] if asked else ["data.h5.partial"])
        if size > 3_000_000:  # all was solved
            assert simulate(tmp_path / "data.h5", pretender, loads, SAID, 8).total == 0


def test_displacement_is_reproduced_from_file_attributes(tmp_path):
    """Only h5py and the attributes are used to compute one displacement again."""
    body = base_held(cube((4, 4, 3), 0.02))
    top = np.isclose(body.mesh.nodes[:, 2], body.mesh.nodes[:, 2].max())
    inside = np.linalg.norm(body.mesh.nodes[body.mesh.tets].mean(axis=1) - [0.04, 0.04, 0.03], axis=1) < 0.015
    mesh = TetMesh(body.mesh.nodes, body.mesh.tets, np.where(inside, 2, 1))
    write_anatomy(tmp_path / "box.vtu", Anatomy(mesh, body.fixed, body.slide_normal, top))
    words = ["simulate", str(tmp_path / "box.vtu"), "--out", str(tmp_path / "a.h5"), "--count", "2", "--device", "cpu"]
    assert main([*words, "--element", "smoothed", "--young", "2000", "--json"]) == 0
    with h5py.File(tmp_path / "a.h5") as file:
        for name in ("title", "tissue", "element", "tool", "date", "anatomy", "sulcus version", "compression", "frame"):
            assert file.attrs[name], name
        assert file.attrs["format"] == FORMAT and json.loads(file.attrs["tissue"])["young"] == 2000.0

        def explained(name, item):
            assert item.attrs["meaning"], name
            if isinstance(item, h5py.Dataset):
                assert len(item.attrs["axes"].split(";")) == item.ndim, name
                assert item.attrs["unit"] in ("m", "N", "s", "1", "m/N"), name
                assert ("RAS" in item.attrs["axes"]) == (item.attrs.get("frame") == "RAS"), name

        file.visititems(lambda name, item: None if name == "loads/Pushed" else explained(name, item))
        units = {name: file[name].attrs["unit"] for name in ("answers/displacement", "unit/displacement")}
        assert units == {"answers/displacement": "m", "unit/displacement": "m/N"}
        part = file["anatomy"]
        mesh = TetMesh(part["nodes"][:], part["tets"][:], part["region"][:])
        anatomy = Anatomy(mesh, part["held"][:], part["slide_normal"][:], part["craniotomy"][:])
        tissue, element = read_tissue_json(file.attrs["tissue"]), file.attrs["element"]
        tool = file["loads/Pushed"]
        load = push(tool["point"][1], tool["force"][1], tool["footprint"][1])
        stored = file["answers/displacement"][1]
        vertex, response = int(file["unit/node"][4]), file["unit/displacement"][4]
    fem = Fem(anatomy, build_push_effects(anatomy, tissue), device="cpu", element=element)
    again = fem.deform(load).displacement[0]
    assert np.abs(stored).max() > 1e-4 and np.abs(again - stored).max() < 1e-3 * np.abs(stored).max()
    assert response[vertex].argmax() == 1 and response[vertex, 1] > 0.0  # row 4: the second node, along y


def test_stored_arrays_of_wrong_type_or_shape_are_rejected(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["a"] = np.zeros(3)
        with pytest.raises(InputError, match="holds float64"):
            read_array(file, "a", "iu")
        with pytest.raises(InputError, match="measures 3, not n x 3"):
            read_array(file, "a", "f", (None, 3))
