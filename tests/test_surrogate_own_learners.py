"""Learners of users: a file or package registers them; they are trained, stored and loaded like others."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from programs import main

from scenes.play.deformers import GUARDED
from sim.accuracy import TRAIN
from sim.bodies.meshfile import write_anatomy
from sim.effects import Elasticity, Held, NodalForce, Slide, ToolForce
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import push
from sim.runtime.user_script import run_script
from surrogate.data.dataset import read_dataset
from surrogate.data.simulate import simulate
from surrogate.data.tool_loads import draw
from surrogate.model.own_learners import OWN_LEARNERS, PLAYER_NAMES, RESERVED_NAMES, find_own_learner, register_learner
from surrogate.model.store import FITTED, load, save
from surrogate.training.train import LEARNERS, POSE_LEARNERS, train

NEAREST = Path(__file__).parents[1] / "examples/nearest.py"


@pytest.fixture
def clean():
    """Nobody has registered anything, and nobody will have."""
    before, modules = dict(OWN_LEARNERS), set(sys.modules)
    OWN_LEARNERS.clear()
    yield
    OWN_LEARNERS.clear()
    OWN_LEARNERS.update(before)
    for name in set(sys.modules) - modules:
        if name.startswith("own_"):
            del sys.modules[name]


@pytest.fixture(scope="module")
def folder(tmp_path_factory, box):
    """A researcher's, outside the packages: data, the brain, and a copy of the example."""
    path = tmp_path_factory.mktemp("own")
    fem = Fem(box, (Elasticity(), Held(), Slide(), ToolForce(), NodalForce()), TRAIN, "cpu", element="p1")
    simulate(path / "data.h5", fem, draw("palpation", box, 100, 0), {"preset": "palpation"})
    write_anatomy(path / "box.vtu", box)
    (path / "my_learner.py").write_text(NEAREST.read_text())
    return path


def forget(name: str) -> None:
    """As in a new process."""
    OWN_LEARNERS.clear()
    for module in [module for module in sys.modules if module.startswith("own_")]:
        del sys.modules[module]
    assert find_own_learner(name) is None


def test_plugin_learner_is_trained_stored_and_played(folder, box, monkeypatch, capsys, clean):
    monkeypatch.chdir(folder)
    words = ["train", "data.h5", "--out", "box.model.npz", "--learners", "nearest,linear", "--json"]
    assert main(words) == 2
    assert "no learner is called nearest" in capsys.readouterr().err and not Path("box.model.npz").exists()
    assert main([*words, "--plugin", "my_learner.py"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert {row["name"] for row in report["scores"]} == {"nearest", "linear"}
    assert all(0.0 < row["mean_percent"] < 60.0 for row in report["scores"])
    trained = load("box.model.npz", box)["nearest"]

    forget("nearest")
    with pytest.raises(InputError, match=r"made by the learner 'nearest', .* --plugin"):
        load("box.model.npz", box)
    run_script("my_learner.py")
    again = load("box.model.npz", box)["nearest"]
    loads = push(box.mesh.nodes[box.craniotomy][:3], np.array([0.0, 0.0, -0.2]), 7e-3)
    assert np.array_equal(again.deform(loads).displacement, trained.deform(loads).displacement)
    assert np.abs(again.deform(loads).displacement).max() > 1e-4

    forget("nearest")
    played = ["render", "press", "--out", "frames", "--every", "60", "--anatomy", "box.vtu", "--deformer", "nearest"]
    assert main(played) == 2
    assert "--plugin" in capsys.readouterr().err
    assert main([*played, "--plugin", "my_learner.py"]) == 0
    with np.load("box.model.npz", allow_pickle=False) as file:
        assert all(not file[name].dtype.hasobject for name in file.files)


READING = "train judge export patient scenes effects demo render collect sensitivity check benchmarks-stages"


@pytest.mark.parametrize("command", READING.split())
def test_model_commands_accept_the_plugin_option(command, capsys):
    """Messages of `load` and `check_learners` refer to this option."""
    with pytest.raises(SystemExit):
        main([*command.split("-"), "--help"])
    assert "--plugin FILE.py" in capsys.readouterr().out


def test_patient_command_accepts_plugin_learner(folder, tmp_path, monkeypatch, capsys, clean):
    monkeypatch.chdir(folder)
    words = ["patient", "none.nii.gz", "--brain", "1", "--tumour", "2", "--out", str(tmp_path / "p.vtu")]
    words += ["--learners", "nearest", "--device", "cpu"]
    assert main(words) == 2 and "no learner is called nearest" in capsys.readouterr().err
    assert main([*words, "--plugin", "my_learner.py"]) == 2
    said = capsys.readouterr().err
    assert "none.nii.gz: no such file" in said and "no learner" not in said


def test_package_learner_is_imported_only_when_selected(tmp_path, monkeypatch, clean):
    (tmp_path / "labs_learners.py").write_text(NEAREST.read_text().replace('"nearest"', '"labs"'))
    made = tmp_path / "labs_learners-1.0.dist-info"
    made.mkdir()
    (made / "METADATA").write_text("Metadata-Version: 2.1\nName: labs-learners\nVersion: 1.0\n")
    (made / "entry_points.txt").write_text("[sulcus.learners]\nlabs = labs_learners\nbroken = no_such_module\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert find_own_learner("other") is None and "labs_learners" not in sys.modules
    found = find_own_learner("labs")
    assert found is not None and found.regressor.__module__ == "labs_learners"
    with pytest.raises(InputError, match="learner broken of no_such_module cannot be loaded"):
        find_own_learner("broken")
    del sys.modules["labs_learners"]


def test_registered_learner_may_have_its_own_encoder(box, clean):
    own = run_script(NEAREST)
    register_learner("along", lambda patch, pushed: pushed.force)(type("Along", (own.Nearest,), {}))
    assert find_own_learner("along").encoder == "along"


def test_built_in_learner_names_are_reserved():
    assert {*LEARNERS, *POSE_LEARNERS, *FITTED} == RESERVED_NAMES
    assert {"auto", "fem", GUARDED} == PLAYER_NAMES


@pytest.mark.parametrize(
    ("name", "encoder", "words"),
    [
        ("svr", "tool", "the name 'svr' is taken"),
        ("series-gp", "tool", "the name 'series-gp' is taken"),
        ("guarded", "tool", "the name 'guarded' is taken"),
        ("mine", "smell", "no encoder is called 'smell': choose one of nodal, rooted, tool"),
    ],
)
def test_invalid_learner_names_are_rejected(name, encoder, words, clean):
    own = run_script(NEAREST)
    with pytest.raises(InputError, match=words):
        register_learner(name, encoder)(own.Nearest)


def test_learner_class_with_missing_methods_is_rejected(clean):
    with pytest.raises(InputError, match="the learner empty has no fit, predict, state, restored"):
        register_learner("empty")(type("Empty", (), {}))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("[:, 0]", r"returns shape \(\d+,\) for \d+ loads: let `predict` give \(\d+, \d+\), all finite"),
        (" * np.nan", r"returns shape \(\d+, \d+\) for \d+ loads: let `predict` give"),
    ],
)
def test_invalid_learner_predictions_are_rejected_in_training(folder, tmp_path, capsys, change, words, clean):
    path = tmp_path / "wrong.py"
    path.write_text(NEAREST.read_text().replace(".astype(np.float32)", change))
    out = tmp_path / "model.npz"
    given = ["train", str(folder / "data.h5"), "--out", str(out), "--learners", "nearest", "--plugin", str(path)]
    assert main(given) == 2 and not out.exists()
    assert re.search(words, capsys.readouterr().err)


def test_learner_state_with_object_array_is_rejected(folder, tmp_path, clean):
    own = run_script(NEAREST)

    class Sly(own.Nearest):
        def state(self):
            return {"thing": np.array([object()])}

    register_learner("sly")(Sly)
    model = train(read_dataset(folder / "data.h5"), ["linear"]).models["linear"]
    part = replace(model.parts[0], regressor=Sly())
    with pytest.raises(InputError, match="a learner's state holds a ndarray that is no array of numbers"):
        save(tmp_path / "sly.npz", {"sly": replace(model, parts=(part,))})
    assert not list(tmp_path.iterdir())
