"""sulcus compared with other packages by one evaluation, with missing packages reported."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from conftest import make_box

from benchmarks.__main__ import main
from benchmarks.commands.solver import NAMES
from benchmarks.peers.comparison import (
    HOUSE,
    OWN,
    PEERS,
    TOLERANCE,
    Engine,
    build_case,
    build_reference_solver,
    compare_engines,
)
from benchmarks.peers.engine_sulcus import build_fem
from sim.bodies.meshfile import write_anatomy

WRONG = """
from benchmarks.peers.engine_sulcus import set_up_solver
from benchmarks.peers.engine_process import serve_loads

def spoilt(case):
    solve = set_up_solver(case)
    return lambda force: 1.00001 * solve(force)

serve_loads(spoilt)
"""
FAILING = "from benchmarks.peers.engine_process import serve_loads; serve_loads(lambda case: lambda force: 1 / 0)"
EXPLICIT = f"""
import sys
from dataclasses import replace
sys.path.insert(0, {str(HOUSE / "benchmarks" / "peers")!r})
import peer_tled
from peer_tled import serve_loads, set_up_solver
"""
DYING = FAILING.replace("1 / 0", "os._exit(3)").replace("from", "import os; from", 1)


@pytest.fixture(scope="module")
def box():
    return make_box(cells=(5, 5, 4), spacing=14e-3, tumour=14e-3, opening=50e-3)


@pytest.fixture(scope="module")
def case(box):
    return build_case(box, 3, 0)


@pytest.fixture(scope="module")
def judge(case):
    return build_reference_solver(case)


def compared(case, judge, *engines):
    """In one process each: how long a first answer takes is of no interest."""
    return compare_engines(case, judge, engines, start_count=0, threads=1, on_result=lambda: None)


def engine(folder, name, code):
    script = folder / f"{name}.py"
    script.write_text(code)
    return Engine(name, "spoilt", (), (str(script),))


def test_peer_list_matches_the_command_choices():
    assert tuple(peer.name for peer in PEERS) == NAMES
    assert all(peer.arguments[0].endswith(".py") and Path(peer.arguments[0]).exists() for peer in PEERS)


def test_comparison_case_fixes_sliding_nodes_and_keeps_force(box, case):
    assert case.held.sum() == (box.fixed.any(axis=1) | box.slide_normal.any(axis=1)).sum() > 0
    assert not case.held.all()
    total = np.linalg.norm(case.force.sum(axis=1), axis=1)
    assert ((total > 0.04) & (total < 0.41)).all()


def test_invalid_and_failed_engines_get_no_good_result(case, judge, tmp_path):
    """An engine with wrong results, one that fails and one that crashes do not stop the others."""
    engines = (
        OWN,
        engine(tmp_path, "wrong", WRONG),
        engine(tmp_path, "failing", FAILING),
        engine(tmp_path, "dying", DYING),
        Engine("absent", "", ("no_module_of_this_name",), ("-m", "absent")),
    )
    calls = []
    rows = compare_engines(case, judge, engines, start_count=1, threads=1, on_result=lambda: calls.append(1))
    ours, wrong, failing, dying, absent = rows
    assert len(calls) == 4 * (1 + len(case.force))
    assert all(answer.good and answer.apart < 1e-4 for answer in ours.answers)
    assert ours.first > 0.0 and ours.further > 0.0 and np.isnan(ours.ratio)
    assert all(TOLERANCE < answer.residual < 1e-3 and answer.apart > 1e-6 for answer in wrong.answers)
    assert all("ZeroDivisionError" in answer.reason for answer in failing.answers)
    assert all("process ended" in answer.reason for answer in dying.answers)
    for row in (wrong, failing, dying):
        assert not any(answer.good for answer in row.answers)
        assert np.isnan([row.first, row.further, row.first_ratio, row.ratio]).all()
    assert "pip install -e" in absent.missing and not absent.answers


def test_solver_command_prints_json_rows(box, tmp_path, capsys):
    write_anatomy(tmp_path / "box.vtu", box)
    words = ["solver", "--mesh", str(tmp_path / "box.vtu"), "--loads", "2", "--starts", "1", "--json"]
    assert main(words) == 0
    said = capsys.readouterr()
    found = json.loads(said.out)
    (mesh,) = found["meshes"]
    (row,) = mesh["rows"]
    assert "factorised once" in row["setting"]
    assert row["engine"].startswith("sulcus") and row["missing"] == "" and row["ratio"] is None
    assert mesh["nodes"] == len(box.mesh.nodes) and len(row["answers"]) == 2 and len(row["firsts"]) == 1
    assert row["tolerance"] == mesh["tolerance"] == 1e-6
    assert all(answer["good"] and answer["residual"] <= 1e-6 for answer in row["answers"])
    assert "2 of 2" in said.err


def test_each_row_states_its_requested_tolerance(box, tmp_path, capsys):
    write_anatomy(tmp_path / "box.vtu", box)
    words = ["--mesh", str(tmp_path / "box.vtu"), "--loads", "2", "--starts", "1", "--peers", "tled"]
    assert main(["solver", *words, "--tolerance", "1e-3", "1e-10"]) == 0
    lines = [line.split(" | ") for line in capsys.readouterr().out.splitlines() if "2 of 2" in line]
    assert [cells[1] for cells in lines] == ["0.001", "0.001", "1e-10", "1e-10"]
    assert [line[0].split()[1] for line in lines] == ["sulcus", "tled"] * 2
    far = [float(cells[-1].split()[1]) for cells in lines]
    assert min(far[:2]) > 1e2 * max(far[2:]) and max(far) < 1e-1


@pytest.mark.parametrize("name", ["tled", "modified-newton", "scikit-fem"])
@pytest.mark.parametrize("tolerance", [1e-4, 1e-10])
def test_peer_engine_finds_the_same_displacement(case, judge, name, tolerance):
    """Each engine stops at the requested tolerance, near the reference solution."""
    peer = next(peer for peer in PEERS if peer.name == name)
    if peer.missing_reason:
        pytest.skip(peer.missing_reason)
    ours, theirs = compared(replace(case, tolerance=tolerance), judge, OWN, peer)
    for row in (ours, theirs):
        assert row.tolerance == tolerance
        assert [answer.reason for answer in row.answers] == [""] * len(case.force)
        assert all(answer.good for answer in row.answers)
        assert max(answer.apart for answer in row.answers) < 1e2 * tolerance
    assert all(answer.residual > 1e-3 * tolerance for answer in ours.answers)  # it was asked for no more than that
    assert theirs.ratio == pytest.approx(
        np.median([b.seconds / a.seconds for a, b in zip(ours.answers[1:], theirs.answers[1:], strict=True)])
    )


def test_only_sulcus_and_tled_run_on_the_gpu():
    moved = {
        engine.name for engine in (OWN, *PEERS) if engine.select_device("cuda").arguments == (*engine.arguments, "cuda")
    }
    assert moved == {"sulcus", "tled"}
    assert all(engine.select_device("cpu") == engine for engine in (OWN, *PEERS))
    assert all(engine.select_device("cuda") == engine for engine in PEERS if engine.name not in moved)


@pytest.mark.gpu
@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device here")
def test_tled_on_gpu_finds_the_same_displacement(case, judge):
    tled = next(peer for peer in PEERS if peer.name == "tled")
    for row in compared(case, judge, OWN.select_device("cuda"), tled.select_device("cuda")):
        assert [answer.reason for answer in row.answers] == [""] * len(case.force)
        assert all(answer.good and answer.apart < 1e-4 for answer in row.answers)


def test_tled_with_other_law_or_few_steps_is_detected(case, judge, tmp_path):
    other = engine(
        tmp_path, "other", EXPLICIT + "serve_loads(lambda case: set_up_solver(replace(case, lam=1.001 * case.lam)))"
    )
    hasty = engine(tmp_path, "hasty", EXPLICIT + "peer_tled.STEPS = 50; serve_loads(set_up_solver)")
    bold = engine(tmp_path, "bold", EXPLICIT + "peer_tled.SAFETY = 1.9; serve_loads(set_up_solver)")
    _, other, hasty, bold = compared(case, judge, OWN, other, hasty, bold)
    assert all(answer.reason == "" and TOLERANCE < answer.residual < 1e-1 for answer in other.answers)
    assert all("not reached in 50 steps" in answer.reason for answer in hasty.answers)
    assert not any(answer.good for answer in (*other.answers, *hasty.answers))
    assert all(answer.good for answer in bold.answers)  # what leaves the law at a long step goes on at a shorter one


@pytest.mark.parametrize(
    "words",
    [
        ("--loads", "1"),
        ("--starts", "0"),
        ("--threads", "0"),
        ("--mesh", "none.vtu"),
        ("--tolerance", "1e-11"),
        ("--tolerance", "nan"),
    ],
)
def test_solver_bench_rejects_invalid_input(words, capsys):
    assert main(["solver", *words]) == 2
    assert words[1] in capsys.readouterr().err


def test_comparison_case_uses_linear_tetrahedra(case):
    assert build_fem(case).space.element == "p1"
