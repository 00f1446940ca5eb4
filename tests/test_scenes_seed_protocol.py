"""`sulcus report --seed-protocol`: a position is predicted without its own loads; the authors' file is not trusted."""

import json
import shutil

import numpy as np
import pytest

from scenes.cli import main
from scenes.report import seed_protocol
from scenes.report.finite_elements import FemVariant, describe_difference
from scenes.report.learner import LearnerSpec
from scenes.report.row import ERROR, TOLERANCE_ALONE
from scenes.report.seed_bodies import POINT_FOOTPRINT, read_seed_mesh
from scenes.report.seed_learners import select_vertices
from sim.errors import InputError
from sim.loads import Pushed
from surrogate.data.dataset import read_dataset

SPECS = (LearnerSpec("published-svr"), LearnerSpec("linear"), FemVariant("FEM p1"))


@pytest.fixture(scope="module")
def seed_arrays(box):
    free = np.intersect1d(box.mesh.surface, np.flatnonzero(~box.fixed.any(axis=1)))
    return {
        "nodes_mm": 1e3 * box.mesh.nodes,
        "tets": box.mesh.tets,
        "region": box.mesh.region,
        "held": np.flatnonzero(box.fixed.all(axis=1)),
        "force_nodes": free[:: len(free) // 4][:4],
    }


@pytest.fixture(scope="module")
def seed_file(seed_arrays, tmp_path_factory):
    path = tmp_path_factory.mktemp("seed") / "mesh.npz"
    np.savez(path, **seed_arrays)
    return path


@pytest.fixture(scope="module")
def study(seed_file):
    body, loads = read_seed_mesh(seed_file, 24)
    study = seed_protocol.SeedStudy(seed_file.with_name("seed-authors.h5"), seed_file.parent, "cpu", 2)
    seed_protocol.simulate_seed(study, body, loads, lambda done, total: None)
    return study


def test_forces_act_on_the_vertices_of_the_file(seed_arrays, seed_file):
    body, loads = read_seed_mesh(seed_file, 100000)
    pushed = loads.get(Pushed)
    assert len(loads) == 4 * 100 * 20 and set(pushed.footprint) == {POINT_FOOTPRINT}
    points = np.unique(pushed.point, axis=0)
    assert np.allclose(points, np.unique(body.mesh.nodes[seed_arrays["force_nodes"]], axis=0), atol=1e-12)
    sizes = np.linalg.norm(pushed.force, axis=1)
    assert np.isclose(sizes.min(), 0.1) and np.isclose(sizes.max(), 1.05)


def test_positions_are_predicted_without_their_loads(study, monkeypatch):
    seen, fit = [], seed_protocol.fit_vertex_models

    def spy(name, anatomy, pushed, displacement):
        seen.append(pushed.point)
        return fit(name, anatomy, pushed, displacement)

    monkeypatch.setattr(seed_protocol, "fit_vertex_models", spy)
    row = seed_protocol.measure_seed_row(study, SPECS[0])
    assert len(seen) == len(study.positions) == 4
    for position, points in zip(study.positions, seen, strict=True):
        assert len(points) and np.linalg.norm(points - position, axis=1).min() > 1e-4
    data = read_dataset(study.data)
    motion = np.linalg.norm(data.read_displacement(select_vertices(data.anatomy))[data.good], axis=2).mean()
    assert row.state == "measured" and row.reference.motion == pytest.approx(1e3 * motion, rel=1e-5)
    assert row.reference.loads == len(row.load_mm) == data.good.sum() and row.loads <= seed_protocol.MAX_TRAINING
    said = seed_protocol.describe_seed_study(study, (row,))
    assert f"published-svr {row.reference.mm.mean:.2g} mm (below 0.2 mm: " in said[-1]


def test_the_command_measures_both_bodies(seed_file, study, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(seed_protocol, "list_seed_specs", lambda: SPECS)
    for name in ("read_seed_mesh", "make_seed_template"):
        monkeypatch.setattr(f"scenes.report.seed_bodies.{name}", lambda path, count: read_seed_mesh(seed_file, 24))
    (tmp_path / "out").mkdir()
    for name in ("seed-authors.h5", "seed-template.h5"):  # a finished data set is not simulated again
        shutil.copy(study.data, tmp_path / "out" / name)
    words = ["report", "--seed-protocol", "--seed-mesh", str(seed_file), "--out", str(tmp_path / "out"), "--device"]
    assert main([*words, "cpu", "--loads", "2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [section["name"] for section in found["sections"]] == ["seed-authors", "seed-template"]
    rows = {row["name"]: row for row in found["sections"][0]["rows"]}
    assert list(rows) == [spec.name for spec in SPECS] and {row["state"] for row in rows.values()} == {"measured"}
    assert rows["FEM p1"]["against"] == TOLERANCE_ALONE
    assert describe_difference(study, FemVariant("FEM p2", element="p2")) == ERROR
    own = rows["FEM p1"]["reference"]
    assert own["mm"]["mean"] < 1e-3 * own["motion"] < 1e-2 * rows["linear"]["reference"]["mm"]["mean"]
    assert (tmp_path / "out/seed-template-time.png").exists()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"nodes_mm": np.zeros(3)}, "nodes_mm has type float64"),
        ({"tets": np.zeros((1, 4))}, "tets has type float64"),
        ({"held": np.array([10**6])}, "held names vertex 1000000"),
        ({"force_nodes": np.array([-1, 0])}, "force_nodes"),
        ({"region": "ones"}, "no tumour"),
        ({"held": None}, "lacks the array 'held'"),
    ],
)
def test_a_wrong_file_is_rejected(changed, message, seed_arrays, tmp_path):
    ((name, array),) = changed.items()
    arrays = seed_arrays | {name: np.ones_like(seed_arrays["region"]) if isinstance(array, str) else array}
    np.savez(tmp_path / "bad.npz", **{key: value for key, value in arrays.items() if value is not None})
    with pytest.raises(InputError, match=message):
        read_seed_mesh(tmp_path / "bad.npz", 10)


def test_options_that_do_not_belong_are_rejected(seed_file, tmp_path, capsys):
    out = ["--out", str(tmp_path)]
    assert main(["report", "--seed-mesh", str(seed_file), *out]) == 2
    assert "--seed-mesh belongs to --seed-protocol" in capsys.readouterr().err
    assert main(["report", "--seed-protocol", "--anatomy", "brain.vtu", *out]) == 2
    assert "leave out --data, --anatomy and --scheduler" in capsys.readouterr().err
