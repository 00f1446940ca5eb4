"""Cells of mesh files of other programs: one body without overlaps, with the mesher's regions."""

import re
from pathlib import Path

import meshio
import numpy as np
import pytest
from boxes import quadratic
from test_sim_meshfile import MESH, write

from sim.bodies.mesh_checks import collect_regions
from sim.bodies.meshfile import read_mesh
from sim.errors import InputError
from sim.geometry.tetmesh import TetMesh

HALF = (MESH.nodes[MESH.tets].mean(axis=1)[:, 2] > MESH.nodes[:, 2].mean()).astype(int)
GMSH = {"gmsh:physical": [HALF + 1], "gmsh:geometrical": [HALF + 7]}


def parted(gap: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and tetrahedra of two halves, each with nodes of its own at the interface."""
    parts = [np.unique(MESH.tets[half == HALF], return_inverse=True) for half in (0, 1)]
    tets = np.concatenate([k.reshape(-1, 4) + (0, len(parts[0][0]))[n] for n, (_, k) in enumerate(parts)])
    return np.concatenate([MESH.nodes[parts[0][0]], MESH.nodes[parts[1][0]] + [0.0, 0.0, gap]]), tets


@pytest.mark.parametrize("quadratic_too", [False, True])
def test_coincident_nodes_are_merged_with_a_note(tmp_path: Path, quadratic_too: bool) -> None:
    points, tets = parted()
    body = TetMesh(points, tets, np.zeros(48, int))
    body, common = (quadratic(body), quadratic(MESH)) if quadratic_too else (body, MESH)
    path = write(
        tmp_path / "a.vtu", points=body.nodes, cells=[("tetra" if body.middles is None else "tetra10", body.table)],
        cell_data={}, point_data={"held": np.tile(body.nodes[:, 2:] < 0.01, 3).astype(np.uint8)},
    )  # fmt: skip
    file = read_mesh(path)
    assert file.notes[0].startswith(f"merged {len(body.nodes) - len(common.nodes)} nodes with others at the same place")
    assert len(file.mesh.surface) == len(MESH.surface) and len(file.point_data["held"]) == len(common.nodes)
    np.testing.assert_array_equal(file.mesh.nodes[file.mesh.tets], points[tets])


def test_pieces_without_common_nodes_are_noted(tmp_path: Path) -> None:
    points, tets = parted(gap=1e-6)
    file = read_mesh(write(tmp_path / "a.vtu", points=points, cells=[("tetra", tets)], cell_data={}))
    assert file.notes[-1].startswith("it is in 2 pieces that share no node, 0.001 mm apart")


def test_coincident_nodes_of_different_data_are_rejected(tmp_path: Path) -> None:
    points, tets = parted()
    path = write(
        tmp_path / "a.vtu",
        points=points,
        cells=[("tetra", tets)],
        cell_data={},
        point_data={"f": np.arange(len(points))},
    )
    with pytest.raises(InputError, match="nodes that coincide have different `f`"):
        read_mesh(path)


@pytest.mark.parametrize(
    ("changes", "region", "note"),
    [
        ({"cell_data": {"gmsh:physical": [HALF + 1]}}, HALF + 1, r"`gmsh:physical`: region 1 \(brain\), region 2"),
        ({"cell_data": GMSH}, HALF + 1, "cell data `gmsh:physical`"),
        ({"cell_data": GMSH | {"gmsh:physical": [HALF * 0]}}, HALF + 7, "cell data `gmsh:geometrical`"),
        ({"cell_data": {"medit:ref": [HALF + 1]}}, HALF + 1, "cell data `medit:ref`"),
        ({"cell_data": {"MaterialIds": [HALF + 1.0], "id": [np.arange(48)]}}, HALF + 1, "cell data `MaterialIds`"),
        ({"cell_data": {"cell_tags": [HALF - 6], "same": [HALF - 6], "E": [HALF + 0.5]}}, HALF - 6, "data `cell_tags`"),
        (
            {"cell_data": GMSH, "field_data": {"Tumor": np.array([1, 3]), "brain": np.array([2, 3])}},
            2 - HALF,
            r"region 1 \(brain\) from brain, region 2 \(tumour\) from Tumor",
        ),
        (
            {"cell_data": {}, "cell_sets": {"BRAIN": [np.flatnonzero(HALF)], "tumour": [np.flatnonzero(HALF == 0)]}},
            2 - HALF,
            r"its sets of cells: region 1 \(brain\) from BRAIN, region 2 \(tumour\) from tumour",
        ),
    ],
)  # fmt: skip
def test_regions_of_a_mesher_are_used_with_a_note(changes: dict, region: np.ndarray, note: str) -> None:
    raw = meshio.Mesh(MESH.nodes, [("tetra", MESH.tets)], **changes)
    found, (said,) = collect_regions(raw, [0])
    np.testing.assert_array_equal(found, region)
    assert re.search(note, said)


@pytest.mark.parametrize(("suffix", "form", "name"), [
    ("msh", "gmsh22", "gmsh:physical"), ("vtu", None, "MaterialIds"),
    ("mesh", None, "medit:ref"), ("med", None, "cell_tags"), ("avs", None, "avsucd:material"), ("xdmf", None, "tag"),
])  # fmt: skip
def test_regions_are_read_from_each_mesh_format(tmp_path: Path, suffix: str, form: str | None, name: str) -> None:
    data = {name: [HALF + 1]} | ({"gmsh:geometrical": [HALF + 1]} if "gmsh" in name else {})
    file = read_mesh(write(tmp_path / f"a.{suffix}", form, cell_data=data))
    np.testing.assert_array_equal(file.mesh.region, HALF + 1)
    assert "regions are those of cell data" in file.notes[-1]


OTHER = 0.5 * MESH.nodes + [0.01, 0.02, 0.03]  # a smaller body inside
CUBE = [[0, 2, 8, 6, 18, 20, 26, 24]]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"cell_data": {"a": [HALF], "b": [MESH.region]}}, "its cell data `a`, `b` may each be its regions"),
        (
            {"cells": [("tetra", MESH.tets), ("hexahedron", CUBE)], "cell_data": {}},
            "a part of its volume is 1 hexahedron: all of it must be tetrahedra",
        ),
        ({"cells": [("tetra", MESH.tets), ("wedge", [CUBE[0][:6]])], "cell_data": {}}, "its volume is 1 wedge"),
        (
            {"cells": [("tetra", np.vstack([MESH.tets, MESH.tets[:3][:, [1, 2, 0, 3]]]))], "cell_data": {}},
            "3 tetrahedra are listed twice",
        ),
        (
            {
                "points": np.vstack([MESH.nodes, OTHER]),
                "cells": [("tetra", np.vstack([MESH.tets, MESH.tets + 27]))],
                "cell_data": {},
            },
            r"its tetrahedra overlap, at \d+ nodes or middles",
        ),
        (
            {
                "points": np.vstack([MESH.nodes, [[0.05, 0.05, 0.01]]]),
                "cells": [("tetra", np.vstack([MESH.tets, [[0, 1, 3, 27]]]))],
                "cell_data": {},
            },
            "its tetrahedra overlap, at",
        ),
    ],
)  # fmt: skip
def test_cells_that_are_not_one_body_are_rejected(tmp_path: Path, changes: dict, sentence: str) -> None:
    path = write(tmp_path / "bad.vtu", **changes)
    with pytest.raises(InputError, match=sentence):
        read_mesh(path)


def test_vtu_packed_with_lz4_is_rejected(tmp_path: Path) -> None:
    path = write(tmp_path / "a.vtu")
    path.write_bytes(path.read_bytes().replace(b"vtkZLibDataCompressor", b"vtkLZ4DataCompressor"))
    with pytest.raises(InputError, match="its arrays are packed by vtkLZ4DataCompressor, and vtkZLib"):
        read_mesh(path)


GMSH_41 = """$MeshFormat
4.1 0 8
$EndMeshFormat
$Entities
0 0 0 2
1 0 0 0 1 1 1 1 1 0
2 0 0 0 1 1 1 {} 0
$EndEntities
$Nodes
1 5 1 5
3 1 0 5
1\n2\n3\n4\n5
0 0 0
0.1 0 0
0 0.1 0
0 0 0.1
0 0 -0.1
$EndNodes
$Elements
2 2 1 2
3 1 4 1
1 1 2 3 4
3 2 4 1
2 1 3 2 5
$EndElements
"""


def test_gmsh_groups_of_some_volumes_only_are_rejected(tmp_path: Path) -> None:
    path = tmp_path / "a.msh"
    path.write_text(GMSH_41.format("1 2"))
    assert read_mesh(path).mesh.region.tolist() == [1, 2]
    path.write_text(GMSH_41.format("0"))
    with pytest.raises(InputError, match="its `gmsh:physical` is given of some cells only: put every volume into a"):
        read_mesh(path)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$ParametricNodes\n1\n1 0 0 0 3 1\n$EndParametricNodes\n"
         "$Elements\n1\n1 4 0 1 1 1 1\n$EndElements", r"parameters of the geometry: .*\(Mesh\.SaveParametric = 0"),
        ("$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n1 1 1 1\n3 1 1 1\n1\n0 0 0 0 0 0\n$EndNodes",
         "parameters of the geometry"),
        ("$NOD\n1\n1 0 0 0\n$ENDNOD", "MSH 1, of which no mesh is read: save it as MSH 4.1"),
        ("$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n1\n1 0 0 0\n$EndNodes\n"
         '$NodeData\n1\n"fixed"\n1\n0.0\n3\n0\n1\n1\n1 np.float64(1.0)\n$EndNodeData',
         "as meshio writes ASCII: save it as binary"),
        ("# vtk DataFile Version 3.0\nt\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 1 double\n0 0 0\nCELLS 1 2\n1 0\n"
         "CELL_TYPES 1\n1\nFIELD FieldData 1\nnames 1 2 string\ngrey\nwhite\n", "has an array of text"),
    ],
)  # fmt: skip
def test_mesh_of_unsupported_kind_is_rejected_with_remedy(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / ("a.vtk" if "vtk" in text else "a.msh")
    path.write_text(text)
    with pytest.raises(InputError, match=reason):
        read_mesh(path)
