"""Untrusted model files: size limits, checks of contents, and messages for rejected files."""

import json
import re
import zipfile
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from limits import memory_below

from scenes.options.outputs import read_attributes as stated_beside
from scenes.tracked.truth import read_truth
from sim.errors import InputError
from sim.geometry.tetmesh import compute_digest
from surrogate.data.dataset import read_dataset
from surrogate.data.simulate import simulate
from surrogate.data.tool_loads import draw
from surrogate.model.conformal import GROWTH, Bound
from surrogate.model.store import load, read_learned_tissue, read_reported_errors, save
from surrogate.model.training_range import Excess
from surrogate.training.train import train

HOUSE = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def models(tmp_path_factory, pretender):
    path = tmp_path_factory.mktemp("store") / "data.h5"
    simulate(path, pretender, draw("palpation", pretender.anatomy, 180, 0), {"preset": "palpation"})
    return train(read_dataset(path), ["linear", "svr"]).models


@pytest.fixture(scope="module")
def stored(models, tmp_path_factory):
    path = tmp_path_factory.mktemp("stored") / "model.npz"
    save(path, models)
    return path


def bounds(**changes):
    def change(model):
        arrays = vars(model.bounds)
        return replace(model, bounds=Bound(**arrays | {name: made(arrays[name]) for name, made in changes.items()}))

    return change


def test_regressor_with_nan_parameters_is_rejected(models, box, tmp_path):
    model = models["linear"]
    linear = type(model.parts[0].regressor).restored({"compliance": model.parts[0].regressor.compliance_ * np.nan})
    save(tmp_path / "model.npz", {"linear": replace(model, parts=(replace(model.parts[0], regressor=linear),))})
    with pytest.raises(InputError, match="'compliance' are no finite numbers"):
        load(tmp_path / "model.npz", box)


def test_unreferenced_arrays_are_not_read(stored, box, tmp_path):
    """64 MB of zeros next to the models, compressed to 64 kB."""
    path = tmp_path / "model.npz"
    path.write_bytes(stored.read_bytes())
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive, archive.open("bomb.npy", "w") as member:
        np.lib.format.write_array(member, np.zeros(2**23))
    with memory_below(2**25):
        assert set(load(path, box)) == {"linear", "svr"}


def rewritten(stored, path, change, seal=""):
    """The file with another header, without its seal as older files, and its members as they were."""
    with zipfile.ZipFile(stored) as source, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as target:
        for name in source.namelist():
            raw = source.read(name)
            if name == "header.npy":
                text = change(re.sub(r', "seal": "\w+"', seal, str(np.load(stored)["header"])))
                with target.open(name, "w") as member:
                    np.lib.format.write_array(member, np.array(text))
            else:
                target.writestr(name, raw)
    return path


@pytest.mark.parametrize(
    ("old", "new"),
    [('"bound": 0.', '"bound": 1.'), ('"svr"', '"gp"'), ('"reach": ', '"reach": 1'), ('"space"', '"space2"')],
)
@pytest.mark.parametrize("read", [load, read_learned_tissue, lambda path, _: read_reported_errors(path)])
def test_header_with_wrong_digest_is_rejected(stored, box, tmp_path, read, old, new):
    path = rewritten(stored, tmp_path / "model.npz", lambda text: text.replace(old, new), r"\g<0>")
    with pytest.raises(InputError, match=r"do not have the digest that it states: it is damaged\. Make one with"):
        read(path, box)
    read(rewritten(stored, path, str), box)  # older files have no seal


@pytest.mark.parametrize("change", [lambda array: 10.0 * array, lambda array: array[::-1], lambda array: array[:, :3]])
def test_array_with_wrong_digest_is_rejected(stored, models, box, tmp_path, change):
    with np.load(stored) as file:
        arrays = {name: file[name] for name in file.files}
    modes = compute_digest(models["svr"].parts[0].basis.modes)
    np.savez(tmp_path / "model.npz", **arrays | {modes: change(arrays[modes])})
    with pytest.raises(InputError, match=rf"its array '{modes}' has another digest: it is damaged\. Make one with"):
        load(tmp_path / "model.npz", box)


READERS = {"truth": lambda path: read_truth(path, "digest", 3, 2**20), "stated": stated_beside}


@pytest.mark.parametrize("name", READERS)
def test_npz_above_decompressed_size_limit_is_not_read(name, tmp_path):
    """40 MB in 40 kB, in the header and in an array."""
    many, header = np.zeros(5_000_000), np.array(json.dumps({"format": "sulcus film 1", "anatomy": "digest"}))
    arrays = dict.fromkeys(("times", "displacement", "T_camera_scan", "T_scan_tool"), many)
    if name != "truth":
        header = np.array(" " * 10_000_000)
    np.savez_compressed(tmp_path / "a.npz", header=header, **arrays)
    with memory_below(2**21), suppress(InputError):
        assert not READERS[name](tmp_path / "a.npz")


def test_only_the_limited_reader_opens_archives():
    paths = [path for room in ("sim", "surrogate", "ar", "scenes") for path in (HOUSE / room).rglob("*.py")]
    found = {path.name for path in paths if re.search(r"np\.load\(|ZipFile\(|torch\.load\(", path.read_text())}
    assert found == {"npz_archive.py"}


def test_model_file_states_its_coordinate_system(stored):
    assert json.loads(str(np.load(stored)["header"]))["space"] == "RAS [m]"


def test_bounds_of_older_files_grow_only_beyond_the_reach(stored, models, box, tmp_path):
    def older(text):
        header = json.loads(text)
        for model in header["models"].values():
            for bound in (model["bounds"], model["tip"]["bound"]):
                del bound["growth"], bound["near"]
                bound["profile"] = bound["edges"]
        return json.dumps(header)

    found = load(rewritten(stored, tmp_path / "model.npz", older), box)["svr"]
    reach = models["svr"].envelope.reach
    for bound in (found.bounds, found.tip.bound):
        assert (float(bound.growth), float(bound.near)) == (1e3 * GROWTH, reach)
    away = np.array([0.0, reach, reach + 1e-3])
    outside = Excess(away, 0.0 * away, 0.0 * away)
    stated = found.bounds.evaluate(np.tile(found.bounds.mean, (3, 1)), np.full(3, 0.2), outside)[0]
    assert stated[0] == stated[1] and stated[2] == pytest.approx((1.0 + GROWTH) * stated[0])


def test_declared_array_size_above_content_is_rejected(stored, box, tmp_path):
    path = tmp_path / "model.npz"
    with zipfile.ZipFile(stored) as source, zipfile.ZipFile(path, "w") as target:
        for name in source.namelist():
            raw = bytearray(source.read(name))
            if name != "header.npy":
                start = raw.index(b"'shape': (") + 10
                raw[start : start + 1] = b"9"  # more than the member holds
            target.writestr(name, bytes(raw))
    with pytest.raises(InputError, match=r"is not what it says|cannot be"):
        load(path, box)


def test_model_of_unregistered_learner_is_rejected(stored, box, tmp_path):
    path = rewritten(stored, tmp_path / "model.npz", lambda text: text.replace('"svr"', '"forest"'))
    with pytest.raises(InputError, match=r"made by the learner 'forest'.*--plugin"):
        load(path, box)


@pytest.mark.parametrize(
    "change",
    [
        lambda text: "[" * 100_000,
        lambda text: "not json",
        lambda text: "[]",
        lambda text: json.dumps({**json.loads(text), "models": []}),
        lambda text: json.dumps({**json.loads(text), "models": {"a": {}}}),
        lambda text: text.replace('"nodes": "', '"nodes": "0'),
        lambda text: text.replace('"reach": ', '"reach": "far", "r": '),
    ],
)
def test_invalid_header_is_rejected_with_one_line_message(stored, box, tmp_path, change):
    path = rewritten(stored, tmp_path / "model.npz", change)
    with pytest.raises(InputError, match="Make one with `sulcus train`") as caught:
        load(path, box)
    assert len(str(caught.value).splitlines()) == 1 and "allow_pickle" not in str(caught.value)


@pytest.mark.parametrize(("offset", "value"), [(6, 1), (8, 99)])
def test_encrypted_or_unsupported_members_are_rejected(stored, box, tmp_path, offset, value):
    raw = bytearray(stored.read_bytes())
    place = -1
    for mark, field in ((b"PK\x03\x04", offset), (b"PK\x01\x02", offset + 2)):
        while (place := raw.find(mark, place + 1)) >= 0:
            raw[place + field] = value
    path = tmp_path / "model.npz"
    path.write_bytes(raw)
    with pytest.raises(InputError, match="cannot be read as a model: it is damaged, or of another kind"):
        load(path, box)


def test_memory_error_is_reported_as_input_error(stored, box, monkeypatch):
    def starved(*given, **named):
        raise MemoryError

    monkeypatch.setattr("numpy.lib.format.read_array", starved)
    with pytest.raises(InputError, match="asks for more memory than there is"):
        load(stored, box)


def test_randomly_damaged_model_file_is_rejected(stored, models, box, tmp_path):
    path = tmp_path / "model.npz"
    for seed in range(25):
        random = np.random.default_rng(seed)
        raw = np.frombuffer(stored.read_bytes(), np.uint8).copy()
        raw[random.integers(0, len(raw), 20)] ^= random.integers(1, 256, 20).astype(np.uint8)
        path.write_bytes(raw.tobytes())
        with pytest.raises(InputError):
            load(path, box)


def test_invalid_model_files_are_rejected(box, tmp_path):
    with pytest.raises(InputError, match="no such file"):
        load(tmp_path / "none.npz", box)
    for name, content in (("text.npz", b"text"), ("zip.npz", b"PK\x03\x04broken"), ("empty.npz", b"")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match="cannot be read as a model"):
            load(tmp_path / name, box)
    np.savez(tmp_path / "arrays.npz", header=np.array("[]"))
    with pytest.raises(InputError, match="cannot be read as a model"):
        load(tmp_path / "arrays.npz", box)
    np.savez(tmp_path / "old.npz", header=np.array(json.dumps({"format": "sulcus model 0"})))
    with pytest.raises(InputError, match="train it again"):
        load(tmp_path / "old.npz", box)
