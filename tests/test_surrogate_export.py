"""Exported models: ONNX Runtime predicts the same values."""

import json
import sys
from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest
from conftest import make_box

from scenes.cli import main
from scenes.script.shipped_files import get_template_path
from sim.accuracy import TRAIN
from sim.bodies.meshfile import read_anatomy, write_anatomy
from sim.deformation import Outcome
from sim.discretisation.footprint import compute_footprint_weights
from sim.effects import NodalForce, build_push_effects
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Pushed, push, stack
from sim.material import Material, to_tissue_json
from surrogate.data.cortex_patch import open_patch
from surrogate.data.dataset import read_dataset
from surrogate.data.simulate import simulate
from surrogate.data.tool_loads import draw
from surrogate.model.conformal import LEVELS
from surrogate.model.store import load, save
from surrogate.onnx_export.export import build_onnx_model
from surrogate.regressors.baselines import Ann
from surrogate.regressors.force_series import Series
from surrogate.training.expansion import SERIES_MODELS, Expansion
from surrogate.training.train import LEARNERS, train

TISSUE = Material("neo-hookean", 3000.0, 0.45)
# Shares of a load's largest motion and of its bound. Numbers of 24 bits are off by 6e-8, and sums of some hundred terms
# of both signs by some ten times that; a bound is the exponential of such a sum, which reaches ten.
MOTION, BOUND = 5e-6, 2e-5


@pytest.fixture(scope="module")
def block():
    return make_box((9, 9, 5), opening=20e-3, depth=18e-3)


@pytest.fixture(scope="module")
def models(block, tmp_path_factory):
    path = tmp_path_factory.mktemp("exchange") / "data.h5"
    fem = Fem(block, (*build_push_effects(block, TISSUE), NodalForce()), TRAIN, "cpu", element="p1")
    provenance = {"tissue": to_tissue_json(TISSUE), "element": "p1"}
    simulate(path, fem, draw("palpation", block, 100, 3), provenance)
    data = read_dataset(path)
    fit = Ann.fit
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Ann, "fit", lambda ann, X, Y: fit(replace(ann, max_iterations=30), X, Y))
        return train(data, expansion=Expansion(data, "cpu")).models


@pytest.fixture(scope="module")
def loads(block, models):
    """Five as they were in training, at corners and edges of triangles, of no force and outside the training range."""
    training, patch = models["linear"].envelope, open_patch(block)
    corner = patch.points[np.argsort(np.linalg.norm(patch.points, axis=1))[:2]]
    at, down = training.points[0], np.array([0.0, 0.0, -0.2])
    return stack(
        [
            draw("palpation", block, 5, 99),
            push(np.vstack([corner, corner.mean(axis=0)]), down, 6e-3),
            push(at, np.array([[0.0, 0.0, 0.0], [0.0, 1e-9, -1e-9], [0.0, 0.0, -0.01]]), 6e-3),
            push(at, np.array([[0.0, 0.0, -0.9], [0.2, 0.0, -0.05], [0.0, 0.1, 0.2]]), 6e-3),
            push(at, np.vstack([down, down]), np.array([3e-3, 12e-3])),
            push(np.array([[20.7e-3, 4.1e-3, 0.0], [4.2e-3, -5.3e-3, 3e-3]]), down, 6e-3),
        ]
    )


def opened(graph):
    onnx.checker.check_model(graph, full_check=True)
    return onnxruntime.InferenceSession(graph.SerializeToString(), providers=["CPUExecutionProvider"])


def asked(session, loads, patch):
    """The answer of a graph, and the loads as they were asked: in single precision."""
    pushed = loads.get(Pushed)
    given = {name: getattr(pushed, name).astype(np.float32) for name in ("point", "force", "footprint")}
    heard = push(given["point"], given["force"], given["footprint"])
    if "weight" in {port.name for port in session.get_inputs()}:
        weight = compute_footprint_weights(
            patch.points, patch.triangles, heard.get(Pushed).point, heard.get(Pushed).footprint
        )
        given["weight"] = weight.toarray().astype(np.float32)
    names = [port.name for port in session.get_outputs()]
    return dict(zip(names, session.run(names, given), strict=True)), heard


def assert_alike(answer, wanted):
    """A graph's answer, and a `Deformation`."""
    size = np.abs(wanted.displacement).max(axis=(1, 2))
    assert (np.abs(answer["displacement"] - wanted.displacement).max(axis=(1, 2)) <= MOTION * size).all()
    assert np.allclose(answer["bound"].T, wanted.bound, rtol=BOUND, atol=0.0, equal_nan=True)
    assert [bool(far) for far in answer["extrapolated"]] == [found is Outcome.EXTRAPOLATED for found in wanted.outcome]
    assert np.array_equal(answer["extrapolated"], answer["excess"] > 0.0)


@pytest.mark.parametrize("cortex", [False, True])
@pytest.mark.parametrize("name", LEARNERS)
def test_onnx_runtime_predicts_as_the_model(models, block, loads, name, cortex):
    model, patch = models[name], open_patch(block)
    session = opened(build_onnx_model(name, model, cortex))
    answer, heard = asked(session, loads, patch)
    wanted = model.deform(heard, at=None if cortex else block.tumour_nodes)
    assert np.array_equal(answer["nodes"], wanted.nodes)
    assert np.array_equal(answer["rest"], block.mesh.nodes[wanted.nodes].astype(np.float32))
    assert_alike(answer, wanted)
    assert answer["extrapolated"].sum() >= 6 and not answer["extrapolated"].all()
    assert not answer["displacement"][8].any() and not answer["bound"][8].any()  # no force
    # The cortex, and the tumour by most learners, stand on tables of forces at nodes.
    tables = cortex or name in ("linear", "pcr", "residual", *SERIES_MODELS)
    assert {"point", "force", "footprint", *(["weight"] if tables else [])} == {p.name for p in session.get_inputs()}
    assert ("pressed" in answer) == tables and (not tables or np.array_equal(answer["pressed"], patch.nodes))
    for row in (0, 12):
        alone, _ = asked(session, loads.select(slice(row, row + 1)), patch)
        assert alone["displacement"].shape == (1, len(wanted.nodes), 3) and alone["bound"].shape == (1, 2)
        assert_alike(alone, wanted.select(np.array([row])))


def test_changed_numpy_kernel_changes_onnx_graph(models, block, loads, monkeypatch):
    monkeypatch.setattr("surrogate.regressors.gp.compute_matern", lambda distance: np.exp(-distance))
    answer, heard = asked(opened(build_onnx_model("gp", models["gp"])), loads, open_patch(block))
    assert_alike(answer, models["gp"].deform(heard, at=block.tumour_nodes))


def test_onnx_graph_matches_the_shipped_model():
    anatomy = read_anatomy(get_template_path())
    for name, model in load(get_template_path().with_suffix(".model.npz"), anatomy).items():
        answer, heard = asked(
            opened(build_onnx_model(name, model)), draw("palpation", anatomy, 40, 7), open_patch(anatomy)
        )
        assert_alike(answer, model.deform(heard, at=anatomy.tumour_nodes))


def test_exported_bounds_support_force_classes_or_none(models, block, loads):
    model, patch = models["svr"], open_patch(block)
    classes = replace(model.bounds, edges=np.array([0.11, 0.21]), quantile=np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
    for bounds in (classes, None):
        other = replace(model, bounds=bounds)
        answer, heard = asked(opened(build_onnx_model("svr", other)), loads, patch)
        assert_alike(answer, other.deform(heard, at=block.tumour_nodes))
        assert np.isnan(answer["bound"]).all() == (bounds is None)


def _series_of(model, nodes):
    """The part of a model that is the series at some vertices, and its number."""
    return next(
        (number, part)
        for number, part in enumerate(model.parts)
        if isinstance(part.regressor, Series) and np.array_equal(part.basis.nodes, nodes)
    )


@pytest.mark.parametrize("taken", [[1], [0, 2, 1, 0, 2]])
def test_exported_series_supports_one_or_many_radii(models, block, loads, taken):
    model = models["series"]
    (number, part), radii = _series_of(model, block.tumour_nodes), np.linspace(5e-3, 8e-3, len(taken))
    series = part.regressor
    of_radii = series.table.integers.reshape(-1, len(series.radii), len(series.table.step))[:, taken]
    table = replace(series.table, integers=of_radii.reshape(-1, len(series.table.step)))
    kept = replace(series, radii=radii, table=table)
    parts = [*model.parts]
    parts[number] = replace(part, regressor=kept)
    other = replace(model, parts=tuple(parts))
    answer, heard = asked(opened(build_onnx_model("series", other)), loads, open_patch(block))
    assert_alike(answer, other.deform(heard, at=block.tumour_nodes))


@pytest.fixture
def folder(models, block, tmp_path):
    write_anatomy(tmp_path / "block.vtu", block)
    save(tmp_path / "block.model.npz", {name: models[name] for name in ("linear", "ann")})
    return tmp_path


def test_onnx_file_contains_descriptive_metadata(folder, models, block, loads, capsys):
    out = folder / "model.onnx"
    assert main(["export", str(folder / "block.model.npz"), "--out", str(out), "--learner", "ann"]) == 0
    assert str(out) in capsys.readouterr().out
    graph = onnx.load(out)
    notes = {note.key: note.value for note in graph.metadata_props}
    assert notes["anatomy"] == block.digest and notes["learner"] == "ann" and notes["frame"] == "RAS"
    assert notes["format"] == "sulcus onnx 1"
    assert (notes["length_unit"], notes["force_unit"], notes["element"]) == ("m", "N", "p1")
    assert json.loads(notes["tissue"])["law"] == "neo-hookean" and graph.producer_version
    assert [float(level) for level in notes["levels"].split(",")] == list(LEVELS)
    assert all(port.doc_string for port in (*graph.graph.input, *graph.graph.output))
    answer, heard = asked(opened(graph), loads, open_patch(block))
    assert_alike(answer, models["ann"].deform(heard, at=block.tumour_nodes))


def test_export_accepts_mesh_path_and_selects_best_learner(folder, models, block):
    best = min(("linear", "ann"), key=lambda name: models[name].bound)
    (folder / "block.model.npz").rename(folder / "other.npz")
    words = ["export", str(folder / "other.npz"), "--out", str(folder / "model.onnx"), "--cortex"]
    assert main([*words, "--anatomy", str(folder / "block.vtu")]) == 0
    graph = onnx.load(folder / "model.onnx")
    assert graph.graph.name == best
    assert next(port for port in graph.graph.output if port.name == "nodes").type.tensor_type.shape.dim[
        0
    ].dim_value == (len(models[best].nodes))


class Foreign(Ann):
    """A regressor without an ONNX graph."""


def test_export_errors_are_reported_as_messages(folder, models, capsys, monkeypatch):
    model, out = str(folder / "block.model.npz"), str(folder / "model.onnx")
    for words, said in (
        ([str(folder / "none.model.npz"), "--out", out], "none.model.npz: no such file"),
        ([model, "--out", out, "--anatomy", str(folder / "none.vtu")], "none.vtu: no such file"),
        ([model, "--out", out, "--learner", "svr"], "no learner is called svr in it: choose from linear, ann"),
        ([model, "--out", str(folder / "model.pb")], "written as .onnx"),
    ):
        assert main(["export", *words]) == 2
        assert said in capsys.readouterr().err
    strange = replace(models["ann"].parts[0], regressor=Foreign())
    with pytest.raises(InputError, match="Foreign, which has no ONNX graph"):
        build_onnx_model("ann", replace(models["ann"], parts=(strange,)))
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert main(["export", model, "--out", out]) == 2
    assert "pip install -e '.[onnx]'" in capsys.readouterr().err and not (folder / "model.onnx").exists()
