"""`sulcus solve`: mesh files, exit codes, and rejected input without output."""

import json
import re
from dataclasses import dataclass
from pathlib import Path

import meshio
import numpy as np
import pytest
from boxes import box, top_forces
from oracle import internal_forces

from scenes.cli import main
from sim.deformation import Outcome
from sim.geometry.tetmesh import MeshWarning
from sim.material import LAWS, Material

MESH = box((2, 2, 3), 0.1, distortion=0.15)
COUNT = len(MESH.nodes)
BASE = MESH.nodes[:, 2] < 1e-9
TOP = MESH.nodes[:, 2] > 0.1 - 1e-9
FORCE = top_forces(MESH, np.array([0.02, 0.01, -0.04]))[0]


@dataclass(frozen=True)
class Run:
    """What one run of the command left behind."""

    code: int
    report: dict
    errors: str
    displacement: np.ndarray | None


@pytest.fixture
def solve(tmp_path: Path, capsys: pytest.CaptureFixture):
    """Write a mesh with `data`, solve it with `flags`, collect everything; `changes` replace meshio's arguments."""

    def run(data: dict, *flags: str, suffix: str = ".vtu", **changes: object) -> Run:
        source, out = tmp_path / f"in{suffix}", tmp_path / "out" / "out.vtu"
        fields = {"points": MESH.nodes, "cells": [("tetra", MESH.tets)], "point_data": data} | changes
        meshio.Mesh(**fields).write(source)  # pyright: ignore[reportArgumentType]
        capsys.readouterr()
        code = main(["solve", str(source), "--device", "cpu", "--out", str(out), "--force", *flags])
        printed = capsys.readouterr()
        lines = printed.out.splitlines()
        assert len(lines) == (0 if code == 2 else 1)
        displacement = meshio.read(out).point_data["displacement"] if out.exists() else None
        return Run(code, json.loads(lines[0]) if lines else {}, printed.err, displacement)

    return run


def refused(run: Run, *words: str) -> None:
    """Exit code 2, one sentence on stderr with these words, and nothing written."""
    assert run.code == 2
    assert run.displacement is None
    assert run.errors.splitlines()[-1].startswith("sulcus solve: ")
    assert "Traceback" not in run.errors
    for word in words:
        assert word in run.errors


@pytest.mark.parametrize("law", LAWS)
def test_solution_is_in_equilibrium_by_independent_formulas(solve, law: str) -> None:
    run = solve({"fixed": BASE.astype(int), "force": FORCE}, "--material", law, "--young", "2500", "--poisson", "0.4")
    assert run.code == 0
    assert run.report["outcome"] == "converged"
    assert run.report["residual"] <= 1e-6
    assert run.report["iterations"] >= 1
    assert run.report["seconds"] >= 0.0
    residual = internal_forces(MESH, {0: Material(law, 2500.0, 0.4)}, run.displacement) - FORCE
    assert np.linalg.norm(residual[~BASE]) <= 1.1e-6 * max(np.linalg.norm(residual[BASE]), np.linalg.norm(FORCE))
    assert not run.displacement[BASE].any()
    largest = 1e3 * np.linalg.norm(run.displacement, axis=1).max()
    assert run.report["largest_displacement_mm"] == pytest.approx(largest, abs=1e-6)


def test_solve_writes_the_mesh_in_metres(solve, tmp_path: Path) -> None:
    solve({"fixed": BASE.astype(int), "force": FORCE}, "--unit", "mm", points=1e3 * MESH.nodes)
    out = meshio.read(tmp_path / "out" / "out.vtu")
    np.testing.assert_allclose(out.points, MESH.nodes, atol=1e-15)
    np.testing.assert_array_equal(out.cells_dict["tetra"], MESH.tets)


def test_explain_option_prints_the_solver_plan(solve) -> None:
    data = {"fixed": BASE.astype(float), "force": FORCE}
    silent, explained = solve(data), solve(data, "--explain")
    assert "plan" not in silent.report and "Newton-CG" not in silent.errors
    assert explained.report["plan"] and all(line in explained.errors for line in explained.report["plan"])
    np.testing.assert_array_equal(explained.displacement, silent.displacement)


def test_mesh_in_millimetres_gives_same_displacement(solve) -> None:
    value = np.where(TOP[:, None], [0.0, 0.0, -2e-3], 0.0)
    fixed = (BASE | TOP).astype(int)
    metres = solve({"fixed": fixed, "force": FORCE, "prescribed": value})
    data = {"fixed": fixed, "force": FORCE, "prescribed": 1e3 * value}
    millimetres = solve(data, "--unit", "mm", points=1e3 * MESH.nodes)
    np.testing.assert_allclose(millimetres.displacement, metres.displacement, atol=1e-9)


@pytest.mark.parametrize("suffix", [".vtu", ".vtk"])
def test_fixed_per_node_equals_fixed_per_component(solve, suffix: str) -> None:
    by_node = solve({"fixed": BASE.astype(float), "force": FORCE}, suffix=suffix)
    by_component = solve({"fixed": np.repeat(BASE[:, None], 3, axis=1).astype(float), "force": FORCE}, suffix=suffix)
    np.testing.assert_array_equal(by_node.displacement, by_component.displacement)
    partly = np.repeat(BASE[:, None], 3, axis=1)
    partly[TOP, 0] = True
    run = solve({"fixed": partly.astype(float), "force": FORCE}, suffix=suffix)
    assert run.code == 0
    assert not run.displacement[partly].any()
    assert np.abs(run.displacement[TOP, 1:]).min() > 0.0


def test_prescribed_displacement_moves_fixed_nodes(solve) -> None:
    value = np.where(TOP[:, None], [1e-3, 0.0, -2e-3], 0.0)
    run = solve({"fixed": (BASE | TOP).astype(int), "prescribed": value})
    assert run.code == 0
    np.testing.assert_allclose(run.displacement[TOP], value[TOP], atol=1e-15)


def test_prescribed_values_at_free_nodes_are_ignored_with_note(solve) -> None:
    value = np.zeros((COUNT, 3))
    value[TOP] = [0.0, 0.0, 5e-3]
    run = solve({"fixed": BASE.astype(int), "prescribed": value, "force": FORCE})
    plain = solve({"fixed": BASE.astype(int), "force": FORCE})
    assert run.code == 0
    assert f"ignored on {TOP.sum()} components" in run.errors
    np.testing.assert_array_equal(run.displacement, plain.displacement)


def test_slide_normal_prevents_normal_displacement(solve) -> None:
    normal = np.where(TOP[:, None], [0.0, 0.6, 0.8], 0.0)
    run = solve({"fixed": BASE.astype(int), "force": FORCE, "slide_normal": normal})
    assert run.code == 0
    assert np.abs(run.displacement[TOP] @ [0.0, 0.6, 0.8]).max() < 1e-14


def test_regions_use_their_own_material_constants(solve) -> None:
    upper = (MESH.nodes[MESH.tets].mean(axis=1)[:, 2] > 0.05).astype(int) * 5
    data = {"fixed": BASE.astype(int), "force": FORCE}
    flags = "--material", "neo-hookean", "--region", "5:30000,0.3", "--tolerance", "1e-9"
    run = solve(data, *flags, cell_data={"region": [upper]})
    assert run.code == 0
    mesh = type(MESH)(MESH.nodes, MESH.tets, upper)
    laws = {0: Material("neo-hookean", 3000.0, 0.49), 5: Material("neo-hookean", 30000.0, 0.3)}
    residual = (internal_forces(mesh, laws, run.displacement) - FORCE)[~BASE]
    assert np.linalg.norm(residual) < 1e-8 * np.linalg.norm(FORCE)


def test_reoriented_and_removed_cells_are_reported(solve) -> None:
    tets = MESH.tets.copy()
    tets[:3] = tets[:3][:, [1, 0, 2, 3]]
    cells = [("tetra", tets), ("triangle", MESH.surface)]
    run = solve({"fixed": BASE.astype(int), "force": FORCE}, cells=cells)
    plain = solve({"fixed": BASE.astype(int), "force": FORCE})
    assert run.code == 0
    assert "turned 3 tetrahedra of negative orientation" in run.errors
    assert "dropped cells that are not tetrahedra" in run.errors
    np.testing.assert_allclose(run.displacement, plain.displacement, atol=1e-8)


def test_nodes_outside_tetrahedra_do_not_move_and_are_reported(solve) -> None:
    points = np.vstack([MESH.nodes, [[1.0, 1.0, 1.0], [2.0, 0.0, 0.0]]])
    data = {"fixed": np.append(BASE, [0, 0]).astype(int), "force": np.vstack([FORCE, np.ones((2, 3))])}
    run = solve(data, points=points)
    assert run.code == 0
    assert "2 nodes belong to no tetrahedron" in run.errors
    assert "left out" in run.errors
    assert run.displacement.shape == (COUNT + 2, 3)
    assert not run.displacement[COUNT:].any()


def test_zero_force_gives_zero_displacement(solve) -> None:
    run = solve({"fixed": BASE.astype(int), "force": np.zeros((COUNT, 3))})
    assert run.code == 0
    assert run.report["iterations"] == 0
    assert not run.displacement.any()
    assert run.report["notes"] == ["nothing moves: no force acts on a node that is free, and no motion is prescribed"]


@pytest.mark.parametrize(("times", "doubted"), [(0.5, False), (1000.0, True)])
def test_prescribed_motion_larger_than_body_gives_warning(solve, times: float, doubted: bool) -> None:
    motion = np.where(BASE[:, None], times * np.ptp(MESH.nodes, axis=0).max() * np.eye(3)[0], 0.0)
    run = solve({"fixed": BASE.astype(int), "prescribed": motion}, "--any-strain")
    assert ("see that it is in the unit of length of the file" in run.errors) == doubted


@pytest.mark.parametrize(("times", "torn"), [(0.1, False), (40.0, True)])
def test_skull_bond_beyond_its_strength_is_noted(solve, times: float, torn: bool) -> None:
    side = np.where((MESH.nodes[:, 0] < 1e-9)[:, None] & ~BASE[:, None], [1.0, 0.0, 0.0], 0.0)
    data = {"fixed": BASE.astype(int), "force": times * FORCE, "slide_normal": side}
    run = solve(data, "--skull", "bonded", "--any-strain")
    assert (run.report["bond"] > 1.0) == torn == ("the bond on the skull bears" in run.errors)
    assert any("the bond" in note for note in run.report["notes"]) == torn


def test_verification_page_lists_all_outcomes() -> None:
    page = (Path(__file__).parents[1] / "docs/verification.md").read_text()
    rows = re.findall(r"^\| `([A-Z_]+)` \|", page, re.MULTILINE)
    assert sorted(rows) == sorted(outcome.name for outcome in Outcome)
    assert all(Outcome[name].good for name in rows[:4]) and not any(Outcome[name].good for name in rows[4:])


def test_single_precision_solution_matches_double_precision(solve) -> None:
    run = solve({"fixed": BASE.astype(int), "force": FORCE}, "--precision", "float32", "--tolerance", "1e-4")
    exact = solve({"fixed": BASE.astype(int), "force": FORCE}, "--tolerance", "1e-10")
    assert run.code == 0
    assert np.linalg.norm(run.displacement - exact.displacement) < 1e-3 * np.linalg.norm(exact.displacement)


def test_solve_without_equilibrium_exits_1_with_finite_state(solve) -> None:
    """The top is pressed through the base: the logarithmic law has no such equilibrium."""
    mesh = box((1, 1, 1), 0.1)
    top = mesh.nodes[:, 2] > 0.05
    run = solve(
        {"fixed": np.ones(8, int), "prescribed": np.where(top[:, None], [0.0, 0.0, -0.11], 0.0)},
        "--material",
        "neo-hookean",
        points=mesh.nodes,
        cells=[("tetra", mesh.tets)],
    )
    assert run.code == 1
    assert run.report["outcome"] not in ("converged", "converged_in_steps")
    assert np.isfinite(run.displacement).all()
    assert run.displacement[top, 2].min() >= -0.1  # not inverted
    # What is written is the equilibrium under the share that is named, in words too.
    assert 0.5 < run.report["load_fraction"] < 0.1 / 0.11
    np.testing.assert_allclose(run.displacement[top, 2], -0.11 * run.report["load_fraction"])
    assert "of the load" in run.errors


def test_start_displacement_reduces_iterations(solve) -> None:
    """In the unit of the file; the displacement is the same."""
    first = solve(GOOD)
    assert first.report["load_fraction"] == 1.0
    mm = {**GOOD, "start": 1e3 * first.displacement}
    again = solve(mm, "--unit", "mm", points=1e3 * MESH.nodes)
    assert again.report["iterations"] == 0 < first.report["iterations"]
    np.testing.assert_allclose(again.displacement, first.displacement, rtol=1e-12)


def test_overflow_gives_finite_report_and_displacement(solve) -> None:
    force = 1e30 / np.abs(FORCE).max() * FORCE
    run = solve({"fixed": BASE.astype(int), "force": force}, "--precision", "float32", "--tolerance", "1e-4")
    assert run.code == 1
    assert run.report["outcome"] == "not_finite"
    assert run.report["residual"] is None
    assert run.report["load_fraction"] == 0.0
    assert np.isfinite(run.displacement).all()


@pytest.mark.parametrize(("depth", "inverted"), [(0.05, 0), (0.11, 6)])
def test_inverted_tetrahedra_are_counted_and_reported(solve, depth: float, inverted: int) -> None:
    """The stable law has an equilibrium with the top below the base, with inverted tetrahedra."""
    mesh = box((1, 1, 1), 0.1)
    top = mesh.nodes[:, 2] > 0.05
    run = solve(
        {"fixed": np.ones(8, int), "prescribed": np.where(top[:, None], [0.0, 0.0, -depth], 0.0)},
        *("--material", "stable-neo-hookean"),
        points=mesh.nodes,
        cells=[("tetra", mesh.tets)],
    )
    assert run.code == (1 if inverted else 0)
    assert run.report["inverted_tetrahedra"] == inverted == (len(mesh.tets) if inverted else 0)
    assert ("6 tetrahedra are inverted" in run.errors) == bool(inverted) == bool(run.report["notes"])


GOOD = {"fixed": BASE.astype(int), "force": FORCE}


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({"force": FORCE}, ["no point data `fixed`"]),
        ({"fixed": BASE.astype(int)}, ["nothing acts on it", "`force`", "`prescribed`"]),
        (
            {"fixed": BASE.astype(int), "prescribed": np.where(TOP[:, None], [0.0, 0.0, 1.0], 0.0)},
            ["nothing acts on it"],
        ),
        ({"fixed": BASE.astype(int), "prescribed": np.zeros((COUNT, 3))}, ["nothing acts on it"]),
        ({"fixed": np.zeros(COUNT, int), "force": FORCE}, ["can move rigidly in 6 of 6 ways"]),
        ({"fixed": np.repeat(BASE[:, None], 2, axis=1).astype(int), "force": FORCE}, ["`fixed` has shape"]),
        ({"fixed": np.where(TOP, np.nan, BASE), "force": FORCE}, ["`fixed` is not finite at node"]),
        ({"fixed": BASE.astype(int), "force": FORCE[:, 0]}, ["`force` has shape"]),
        ({"fixed": BASE.astype(int), "force": np.where(TOP[:, None], np.nan, FORCE)}, ["`force` is not finite"]),
        ({"fixed": BASE.astype(int), "force": np.where(TOP[:, None], np.inf, FORCE)}, ["`force` is not finite"]),
        (
            {"fixed": BASE.astype(int), "prescribed": np.where(BASE[:, None], np.nan, np.zeros((COUNT, 3)))},
            ["`prescribed` is not finite"],
        ),
        (GOOD | {"slide_normal": np.full((COUNT, 3), 0.5)}, ["normalise"]),
        (GOOD | {"slide_normal": np.zeros(COUNT)}, ["`slide_normal` has shape"]),
        (GOOD | {"start": np.zeros(COUNT)}, ["`start` has shape"]),
        (GOOD | {"start": np.full((COUNT, 3), np.nan)}, ["`start` is not finite"]),
    ],
)
def test_solve_rejects_bad_point_data(solve, data: dict, words: list[str]) -> None:
    refused(solve(data), *words)


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--poisson", "0.5"], ["Poisson's ratio is 0.5"]),
        (["--poisson", "nan"], ["Poisson's ratio is nan"]),
        (["--poisson", "-1"], ["Poisson's ratio is -1"]),
        (["--young", "-1"], ["Young's modulus is -1"]),
        (["--young", "0"], ["Young's modulus is 0"]),
        (["--young", "nan"], ["Young's modulus is nan"]),
        (["--young", "inf"], ["Young's modulus is inf"]),
        (["--tolerance", "1e-13"], ["1e-13", "1e-11"]),
        (["--tolerance", "nan"], ["tolerance of nan"]),
        (["--tolerance", "1"], ["tolerance of 1"]),
        (["--precision", "float32", "--tolerance", "1e-6"], ["2e-05", "float64"]),
        (["--region", "7:3000,0.4"], ["region 7", "It has region 0"]),
        (["--region", "0:3000,0.4,1"], ["--region 0:3000,0.4,1"]),
        (["--region", "zero:3000,0.4"], ["--region zero:3000,0.4"]),
        (["--region", "0:3000,0.5"], ["--region 0:3000,0.5", "Poisson's ratio"]),
        (["--region", "0:3000,0.4", "--region", "0:9000,0.4"], ["--region 0", "twice"]),
        (["--device", "tpu"], ["no device 'tpu'"]),
    ],
)
def test_solve_rejects_bad_option_values(solve, flags: list[str], words: list[str]) -> None:
    refused(solve(GOOD, *flags), *words)


@pytest.mark.parametrize("flags", [["--material", "jelly"], ["--unit", "inch"], ["--young", "soft"], ["--nonsense"]])
def test_solve_exits_with_2_for_options_rejected_by_parser(solve, flags: list[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        solve(GOOD, *flags)
    assert caught.value.code == 2


def test_mesh_piece_without_support_is_rejected(solve) -> None:
    points = np.vstack([MESH.nodes, MESH.nodes + [1.0, 0.0, 0.0]])
    data = {"fixed": np.append(BASE, np.zeros(COUNT)).astype(int), "force": np.vstack([FORCE, FORCE])}
    run = solve(data, points=points, cells=[("tetra", np.vstack([MESH.tets, MESH.tets + COUNT]))])
    refused(run, f"a loose piece of {COUNT} nodes", "hold at least three nodes")


@pytest.mark.parametrize("shared", [1, 2])
def test_piece_attached_by_corner_or_edge_is_rejected(solve, shared: int) -> None:
    """The piece touches the fixed body, but rotates about the shared nodes."""
    top = np.flatnonzero(TOP)[:shared]
    apex = MESH.nodes[top].mean(axis=0) + [0.0, 0.0, 0.05]
    extra = apex + 0.02 * np.random.default_rng(3).normal(size=(4 - shared, 3))
    piece = np.append(top, COUNT + np.arange(4 - shared))
    points = np.vstack([MESH.nodes, extra])
    data = {"fixed": np.append(BASE, np.zeros(4 - shared)).astype(int)}
    data["force"] = np.vstack([FORCE, np.full((4 - shared, 3), 1e-3)])
    run = solve(data, points=points, cells=[("tetra", np.vstack([MESH.tets, piece]))])
    refused(run, "can move rigidly")


def bridge(rigid: bool) -> dict:
    """A piece on three corners of the box's top, joined to it by no face; `rigid`: the box's base is held."""
    feet = [int(np.argmin(np.linalg.norm(MESH.nodes - p, axis=1))) for p in MESH.nodes[TOP][[0, 2, 6]]]
    points = np.vstack([MESH.nodes, [[0.02, 0.02, 0.15], [0.04, 0.03, 0.13]]])
    tets = np.array([[feet[0], feet[1], COUNT, COUNT + 1], [feet[0], feet[2], COUNT, COUNT + 1]])
    return {
        "data": {"fixed": np.append(BASE & rigid, [0, 0]).astype(int), "force": np.vstack([FORCE, np.zeros((2, 3))])},
        "points": points,
        "cells": [("tetra", np.vstack([MESH.tets, tets]))],
    }


def test_piece_attached_at_three_corners_is_supported(solve) -> None:
    assert solve(**bridge(rigid=True)).code == 0


def test_piece_attached_to_unsupported_body_is_rejected(solve) -> None:
    refused(solve(**bridge(rigid=False)), "can move rigidly in 6 ways")


def test_bad_output_name_is_rejected_before_reading_the_mesh(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["solve", str(tmp_path / "none.vtu"), "--out", str(tmp_path / "a.txt")]) == 2
    assert ".vtu" in capsys.readouterr().err


def test_solve_rejects_missing_mesh_file(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["solve", str(tmp_path / "none.vtu"), "--out", str(tmp_path / "new" / "a.vtu")]) == 2
    assert "no such file" in capsys.readouterr().err
    assert not (tmp_path / "new" / "a.vtu").exists()


def test_sliver_tetrahedra_give_a_warning(solve) -> None:
    with pytest.warns(MeshWarning, match="dihedral angle below 1 degree"):
        run = solve(GOOD, points=MESH.nodes * [1.0, 1.0, 0.005])
    assert run.code == 0
