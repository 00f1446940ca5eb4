"""Option --element: quadratic meshes as input, equal bodies from different files, and rejected input."""

import json
from itertools import combinations
from pathlib import Path

import meshio
import numpy as np
import pytest
from boxes import box, quadratic, top_forces
from oracle import internal_forces

from scenes.cli import main
from sim.discretisation.space import discretise
from sim.elements import ELEMENTS
from sim.geometry.tetmesh import TetMesh
from sim.material import BRAIN, Material

LINEAR = box((2, 2, 3), 0.1, distortion=0.15)
STRAIGHT, CURVED = quadratic(LINEAR), quadratic(LINEAR, curved=0.05)
COUNT, ALL = len(LINEAR.nodes), len(CURVED.nodes)
TOTAL = np.array([0.02, 0.01, -0.04])
BASE = STRAIGHT.nodes[:, 2] < 1e-9
FORCE = np.vstack([top_forces(LINEAR, TOTAL)[0], np.zeros((ALL - COUNT, 3))])


@pytest.fixture
def solve(tmp_path: Path, capsys: pytest.CaptureFixture):
    """Solve a mesh, its cells as the mesh has them: exit code, report, displacement, stderr."""

    def run(mesh: TetMesh, data: dict, *flags: str, **changes: object) -> tuple[int, dict, np.ndarray, str]:
        source, out = tmp_path / "in.vtu", tmp_path / "out.vtu"
        kind = "tetra" if mesh.middles is None else "tetra10"
        fields = {"points": mesh.nodes, "cells": [(kind, mesh.table)], "point_data": data} | changes
        meshio.Mesh(**fields).write(source)  # pyright: ignore[reportArgumentType]
        out.unlink(missing_ok=True)
        capsys.readouterr()
        code = main(["solve", str(source), "--device", "cpu", "--tolerance", "1e-9", "--out", str(out), *flags])
        said = capsys.readouterr()
        assert out.exists() == (code != 2)
        report = json.loads(said.out) if said.out else {}
        found = meshio.read(out).point_data["displacement"] if out.exists() else np.zeros(0)
        return code, report, found, said.err

    return run


@pytest.mark.parametrize("element", ELEMENTS)
def test_linear_mesh_is_solved_with_each_element(solve, element: str) -> None:
    data = {"fixed": BASE[:COUNT].astype(int), "force": FORCE[:COUNT]}
    code, report, found, _ = solve(LINEAR, data, "--element", element)
    assert code == 0 and found.shape == (COUNT, 3)
    assert report["element"] == element and report["nodes"] == discretise(LINEAR, element).count
    by_default = solve(LINEAR, data)
    assert by_default[1]["element"] == "p1"
    assert np.array_equal(by_default[2], found) == (element == "p1")


def middles_held_by_the_rule(held: np.ndarray) -> np.ndarray:
    """(ALL, 3) bool from (COUNT, 3): a middle where its edge lies on a surface triangle whose corners are all held."""
    ends = {}
    assert STRAIGHT.middles is not None
    for tet, middles in zip(STRAIGHT.tets.tolist(), STRAIGHT.middles.tolist(), strict=True):
        a, b, c, d = tet
        ends |= dict(zip(map(frozenset, ((a, b), (b, c), (a, c), (a, d), (b, d), (c, d))), middles, strict=True))
    out = np.vstack([held, np.zeros((ALL - COUNT, 3), bool)])
    for triangle in LINEAR.surface.tolist():
        for edge in combinations(triangle, 2):
            out[ends[frozenset(edge)]] |= held[triangle].all(axis=0)
    return out


def test_linear_mesh_with_p2_equals_straight_quadratic_mesh(solve) -> None:
    """Fixed nodes of a wall and single ones; prescribed values are linear along the edges of the wall."""
    held = np.repeat(BASE[:COUNT, None], 3, axis=1)
    wall = LINEAR.nodes[:, 0] < 1e-9
    held[wall, 0] = True  # slides in its plane
    held[COUNT - 1] = True  # alone: none of its edges is held
    held[np.flatnonzero(wall)[-2:], 1] = True  # an edge without a third corner
    rule = middles_held_by_the_rule(held)
    assert rule[COUNT:, 0].sum() > rule[COUNT:, 1].sum() > 0
    slope = np.array([[0.02, 0.0, 0.01], [0.0, -0.01, 0.0], [0.0, 0.02, 0.01]])
    own = {"fixed": held.astype(int), "force": FORCE[:COUNT], "prescribed": LINEAR.nodes @ slope * held}
    all_nodes = {"fixed": rule.astype(int), "force": FORCE, "prescribed": STRAIGHT.nodes @ slope * rule}
    code, report, found, _ = solve(LINEAR, own, "--element", "p2")
    straight = solve(STRAIGHT, all_nodes)
    assert code == straight[0] == 0
    assert report["nodes"] == straight[1]["nodes"] == ALL and straight[1]["element"] == "p2"
    assert straight[2].shape == (ALL, 3)
    np.testing.assert_allclose(straight[2][:COUNT], found, rtol=0, atol=1e-8 * np.abs(found).max())
    assert np.abs(found).max() > 1e-3


def test_curved_mesh_equilibrium_by_independent_formulas(solve) -> None:
    force = FORCE + top_forces(CURVED, TOTAL / 2.0)[0]  # on mid-edge nodes too
    data = {"fixed": BASE.astype(int), "force": force}
    code, report, found, _ = solve(CURVED, data, "--material", "neo-hookean", "--young", "2500", "--poisson", "0.4")
    assert code == 0 and report["inverted_tetrahedra"] == 0 and not found[BASE].any()
    residual = internal_forces(CURVED, {0: Material("neo-hookean", 2500.0, 0.4)}, found, "p2") - force
    assert np.linalg.norm(residual[~BASE]) <= 1e-8 * np.linalg.norm(residual[BASE])


@pytest.mark.parametrize("seen", ["in a mirror", "with corners exchanged"])
def test_curved_mesh_of_negative_orientation_is_mirrored(solve, seen: str) -> None:
    """Corners are swapped; each mid-edge node stays on its edge, to keep the curved elements."""
    data = {"fixed": BASE.astype(int), "force": FORCE}
    plain = solve(CURVED, data)[2]
    mirror = np.array([-1.0, 1.0, 1.0]) if seen == "in a mirror" else np.ones(3)
    table = CURVED.table if seen == "in a mirror" else CURVED.table[:, [1, 0, 2, 3, 4, 6, 5, 8, 7, 9]]
    changes = {"points": CURVED.nodes * mirror, "cells": [("tetra10", table)]}
    code, _, found, errors = solve(CURVED, data | {"force": FORCE * mirror}, **changes)
    assert code == 0 and f"turned {len(table)} tetrahedra" in errors
    np.testing.assert_allclose(found, plain * mirror, rtol=0, atol=1e-8 * np.abs(plain).max())


def test_mid_edge_nodes_are_fixed_only_by_the_file(solve) -> None:
    corners = BASE & (np.arange(ALL) < COUNT)
    found = solve(STRAIGHT, {"fixed": corners.astype(int), "force": FORCE})[2]
    assert not found[corners].any() and (np.abs(found[BASE & ~corners]).max(axis=1) > 0.0).all()
    # Held by its mid-edge nodes alone, a body is held all the same.
    code, _, found, _ = solve(STRAIGHT, {"fixed": (BASE & ~corners).astype(int), "force": FORCE})
    assert code == 0 and not found[BASE & ~corners].any() and found[corners].any()


def test_body_with_all_vertices_fixed_deforms_at_mid_edges(solve) -> None:
    """Only mid-edge nodes are free: the coarse level of the preconditioner is empty."""
    slope = np.array([[0.1, 0.0, 0.02], [0.0, -0.1, 0.0], [0.0, 0.2, 0.05]])
    own = {"fixed": np.ones(COUNT, int), "prescribed": LINEAR.nodes @ slope}
    code, _, found, _ = solve(LINEAR, own, "--element", "p2")
    assert code == 0
    np.testing.assert_allclose(found, own["prescribed"], rtol=0, atol=1e-15)
    corners = np.arange(ALL) < COUNT
    code, _, found, _ = solve(STRAIGHT, {"fixed": corners.astype(int), "prescribed": STRAIGHT.nodes @ slope})
    assert code == 0
    force = internal_forces(STRAIGHT, {0: BRAIN}, found, "p2")
    assert np.linalg.norm(force[~corners]) <= 1e-8 * np.linalg.norm(force[corners])


def test_node_outside_quadratic_tetrahedra_does_not_move(solve) -> None:
    data = {"fixed": np.append(BASE, False).astype(int), "force": np.vstack([FORCE, np.ones(3)])}
    code, _, found, errors = solve(CURVED, data, points=np.vstack([CURVED.nodes, np.full(3, 0.5)]))
    assert code == 0 and "1 nodes belong to no tetrahedron" in errors and not found[-1].any()


def test_element_folded_at_mid_edge_counts_as_inverted(solve) -> None:
    """All corners stay fixed: their linear tetrahedra are valid."""
    assert STRAIGHT.middles is not None
    node = STRAIGHT.middles[0, 0]
    ends = STRAIGHT.nodes[STRAIGHT.tets[0, :2]]
    value = np.zeros((ALL, 3))
    value[node] = 0.45 * (ends[1] - ends[0])  # 0.25 would already stop the edge at one end
    data = {"fixed": np.ones(ALL, int), "prescribed": value}
    code, report, found, errors = solve(STRAIGHT, data, "--material", "stable-neo-hookean")
    around = int((STRAIGHT.middles == node).any(axis=1).sum())
    assert code == 1 and np.array_equal(found, value)
    assert report["inverted_tetrahedra"] == around > 0 and f"{around} tetrahedra are inverted" in errors


@pytest.mark.parametrize("element", ["p1", "smoothed"])
def test_linear_element_on_quadratic_mesh_is_rejected(solve, element: str) -> None:
    code, _, _, errors = solve(CURVED, {"fixed": BASE.astype(int), "force": FORCE}, "--element", element)
    assert code == 2 and f"not {element}: use p2" in errors


def test_mesh_of_linear_and_quadratic_tetrahedra_is_rejected(solve) -> None:
    cells = [("tetra", CURVED.tets[:5]), ("tetra10", CURVED.table[5:])]
    code, _, _, errors = solve(CURVED, {"fixed": BASE.astype(int), "force": FORCE}, cells=cells)
    assert code == 2 and "tetra and tetra10" in errors


def test_quadratic_mesh_folded_at_rest_is_rejected(solve) -> None:
    assert STRAIGHT.middles is not None
    nodes = STRAIGHT.nodes.copy()
    nodes[STRAIGHT.middles[0, 0]] = nodes[STRAIGHT.tets[0, :2]].T @ [0.95, 0.05]
    code, _, _, errors = solve(STRAIGHT, {"fixed": BASE.astype(int), "force": FORCE}, points=nodes)
    assert code == 2 and "folded over" in errors


def test_unknown_element_is_rejected(solve) -> None:
    with pytest.raises(SystemExit) as caught:
        solve(LINEAR, {}, "--element", "cubic")
    assert caught.value.code == 2
