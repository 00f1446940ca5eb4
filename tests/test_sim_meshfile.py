"""Mesh files: several input formats, `.vtu` output, rejected files with messages, no partial files."""

import warnings
from pathlib import Path

import meshio
import numpy as np
import pytest
from boxes import box, hold, quadratic

from sim.anatomy import Anatomy
from sim.bodies.meshfile import read_anatomy, read_mesh, write_anatomy, write_mesh
from sim.errors import InputError
from sim.geometry.tetmesh import QUADRATIC_EDGES, MeshWarning, TetMesh

BOX = box((2, 2, 2), 0.1, distortion=0.2)
MESH = TetMesh(BOX.nodes, BOX.tets, np.arange(len(BOX.tets)) % 3)
CURVED = quadratic(MESH, curved=0.05)


def write(path: Path, file_format: str | None = None, **changes: object) -> Path:
    """A file by meshio, as another program would write it."""
    fields = {
        "points": MESH.nodes,
        "cells": [("tetra", MESH.tets)],
        "cell_data": {"region": [MESH.region]},
        "point_data": {},
    } | changes
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # meshio remarks on what a format cannot hold
        meshio.Mesh(**fields).write(path, file_format)  # pyright: ignore[reportArgumentType]
    return path


@pytest.mark.parametrize("mesh", [MESH, CURVED], ids=["linear", "quadratic"])
def test_mesh_round_trip_is_exact(tmp_path: Path, mesh: TetMesh) -> None:
    value = np.random.default_rng(0).normal(size=(len(mesh.nodes), 3))
    write_mesh(tmp_path / "a.vtu", mesh, {"displacement": value})
    file = read_mesh(tmp_path / "a.vtu")
    assert file.mesh.digest == mesh.digest
    assert (mesh is CURVED) == (mesh.digest != TetMesh(mesh.nodes, mesh.tets, mesh.region).digest)
    np.testing.assert_array_equal(file.point_data["displacement"], value)
    assert file.notes == ()


@pytest.mark.parametrize("mesh", [MESH, CURVED], ids=["linear", "quadratic"])
def test_anatomy_round_trip_is_exact(tmp_path: Path, mesh: TetMesh) -> None:
    rng = np.random.default_rng(1)
    count = len(mesh.nodes)
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    whole = hold(mesh, rng.random((count, 3)) < 0.3, normal * (rng.random((count, 1)) < 0.5))
    anatomy = Anatomy(mesh, whole.fixed, whole.slide_normal, rng.random(count) < 0.5)
    write_anatomy(tmp_path / "a.vtu", anatomy)
    assert read_anatomy(tmp_path / "a.vtu").digest == anatomy.digest


@pytest.mark.parametrize("form", ["vtu", "vtk", "gmsh", "gmsh22", "abaqus", "xdmf"])
def test_quadratic_tetrahedra_are_read_unchanged(tmp_path: Path, form: str) -> None:
    suffix = {"gmsh": "msh", "gmsh22": "msh", "abaqus": "inp"}.get(form, form)
    file = read_mesh(write(tmp_path / f"a.{suffix}", form, points=CURVED.nodes, cells=[("tetra10", CURVED.table)]))
    np.testing.assert_allclose(file.mesh.nodes, CURVED.nodes, atol=1e-12)
    np.testing.assert_array_equal(file.mesh.table, CURVED.table)
    assert file.notes == ()


@pytest.mark.parametrize("version", [2.2, 4.1])
def test_gmsh_order_of_mid_edge_nodes_is_converted(tmp_path: Path, version: float) -> None:
    """Gmsh's manual, "Node ordering": the last two are the middles of edges 2-3 and 1-3. Written without meshio."""
    corners = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]])
    ends = np.array([[0, 1], [1, 2], [2, 0], [3, 0], [2, 3], [1, 3]])
    points = np.vstack([corners, corners[ends].mean(axis=1)])
    lines = [" ".join(map(str, point)) for point in points]
    tags = range(1, 11)
    if version < 4:
        nodes = ["10", *(f"{tag} {line}" for tag, line in zip(tags, lines, strict=True))]
        elements = ["1", "1 11 2 0 1 " + " ".join(map(str, tags))]
    else:
        nodes = ["1 10 1 10", "3 1 0 10", *map(str, tags), *lines]
        elements = ["1 1 1 1", "3 1 11 1", "1 " + " ".join(map(str, tags))]
    sections = {"MeshFormat": [f"{version} 0 8"], "Nodes": nodes, "Elements": elements}
    text = "\n".join(f"${name}\n" + "\n".join(body) + f"\n$End{name}" for name, body in sections.items())
    (tmp_path / "a.msh").write_text(text + "\n")
    mesh = read_mesh(tmp_path / "a.msh").mesh
    assert mesh.middles is not None
    np.testing.assert_allclose(mesh.nodes[mesh.middles], mesh.nodes[mesh.tets[:, QUADRATIC_EDGES]].mean(axis=2))


def test_mesh_without_anatomy_data_is_rejected_as_anatomy(tmp_path: Path) -> None:
    write_mesh(tmp_path / "a.vtu", MESH, {"held": np.zeros((27, 3))})
    with pytest.raises(InputError, match="no point data `slide_normal`, `craniotomy`"):
        read_anatomy(tmp_path / "a.vtu")


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh", ".mesh", ".inp", ".xdmf"])
def test_mesh_formats_give_the_same_mesh(tmp_path: Path, suffix: str) -> None:
    file = read_mesh(write(tmp_path / f"a{suffix}"))
    np.testing.assert_allclose(file.mesh.nodes, MESH.nodes, atol=1e-12)
    np.testing.assert_array_equal(file.mesh.tets, MESH.tets)


def test_mesh_in_millimetres_requires_the_unit(tmp_path: Path) -> None:
    path = write(tmp_path / "a.vtu", points=1e3 * MESH.nodes)
    np.testing.assert_allclose(read_mesh(path, "mm").mesh.nodes, MESH.nodes, rtol=1e-15)
    with pytest.warns(MeshWarning, match="with unit mm if it has millimetres"):
        read_mesh(path)


def test_mesh_without_regions_has_one_region(tmp_path: Path) -> None:
    assert not read_mesh(write(tmp_path / "a.vtu", cell_data={})).mesh.region.any()


def test_regions_stored_as_whole_floats_are_read(tmp_path: Path) -> None:
    path = write(tmp_path / "a.vtu", cell_data={"region": [MESH.region.astype(float)]})
    np.testing.assert_array_equal(read_mesh(path).mesh.region, MESH.region)


def test_negative_tetrahedra_are_reoriented_with_a_note(tmp_path: Path) -> None:
    tets = MESH.tets.copy()
    tets[:5] = tets[:5][:, [1, 0, 2, 3]]
    file = read_mesh(write(tmp_path / "a.vtu", cells=[("tetra", tets)]))
    assert file.notes == ("turned 5 tetrahedra of negative orientation",)
    assert file.mesh.volumes.min() > 0.0


def test_mid_edge_nodes_follow_reoriented_tetrahedra(tmp_path: Path) -> None:
    """A mirrored mesh, and one whose corners another program numbered in opposite order."""
    mirrored = read_mesh(
        write(tmp_path / "a.vtu", points=CURVED.nodes * [-1.0, 1.0, 1.0], cells=[("tetra10", CURVED.table)])
    )
    assert mirrored.notes == ("turned 48 tetrahedra of negative orientation",)
    middle = {frozenset(edge): node for edge, node in _edges(CURVED)}
    assert {frozenset(edge): node for edge, node in _edges(mirrored.mesh)} == middle


def _edges(mesh: TetMesh) -> list[tuple[np.ndarray, int]]:
    assert mesh.middles is not None
    return list(zip(mesh.tets[:, QUADRATIC_EDGES].reshape(-1, 2), mesh.middles.ravel(), strict=True))


def test_other_cells_are_dropped_with_a_note(tmp_path: Path) -> None:
    """Regions stay with their tetrahedra, in any order of the cells."""
    cells = [("triangle", MESH.surface), ("tetra", MESH.tets[:20]), ("line", [[0, 1]]), ("tetra", MESH.tets[20:])]
    region = [np.full(len(MESH.surface), 9), MESH.region[:20], np.array([8]), MESH.region[20:]]
    file = read_mesh(write(tmp_path / "a.vtu", cells=cells, cell_data={"region": region}))
    assert file.notes == ("dropped cells that are not tetrahedra: 1 line, 48 triangle",)
    np.testing.assert_array_equal(file.mesh.tets, MESH.tets)
    np.testing.assert_array_equal(file.mesh.region, MESH.region)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"cells": [("triangle", MESH.surface)], "cell_data": {}}, "holds triangle, but no tetrahedra"),
        (
            {"cells": [("tetra", MESH.tets), ("tetra10", np.arange(10)[None])], "cell_data": {}},
            "holds tetra and tetra10, which do not conform",
        ),
        ({"cells": [("tetra10", np.arange(10)[None])], "cell_data": {}}, "zero or negative"),
        ({"cells": [("tetra10", np.tile(MESH.tets, 3)[:, :10])], "cell_data": {}}, "a corner and the middle"),
        (
            {"cells": [("tetra10", np.hstack([MESH.tets, np.full((48, 6), 27)]))], "cell_data": {}},
            "middles name a node",
        ),
        ({"cell_data": {"region": [MESH.region + 0.5]}}, "`region` must be one whole number"),
        ({"cell_data": {"region": [np.where(MESH.region == 1, np.nan, 1.0)]}}, "`region` must be one whole number"),
        ({"cell_data": {"region": [np.zeros((48, 3))]}}, "`region` must be one whole number"),
        ({"cell_data": {"region": [np.full(48, 2**40)]}}, "`region`"),
        ({"points": np.where(np.arange(81).reshape(27, 3) == 40, np.nan, MESH.nodes)}, "node 13 has the coordinates"),
        ({"points": np.where(np.arange(81).reshape(27, 3) == 40, np.inf, MESH.nodes)}, "node 13 has the coordinates"),
        ({"cells": [("tetra", np.where(MESH.tets == 5, 27, MESH.tets))]}, "node 27, but the mesh has nodes 0 to 26"),
        ({"cells": [("tetra", np.where(MESH.tets == 5, -1, MESH.tets))]}, "node -1"),
        ({"cells": [("tetra", MESH.tets[:, [0, 1, 2, 2]])]}, "zero or negative"),
    ],
)
def test_bad_mesh_files_are_rejected_by_name(tmp_path: Path, changes: dict, sentence: str) -> None:
    path = write(tmp_path / "bad.vtu", **changes)
    with pytest.raises(InputError, match=sentence) as caught:
        read_mesh(path)
    assert str(caught.value).startswith(str(path))


def test_missing_mesh_file_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_mesh(tmp_path / "none.vtu")
    with pytest.raises(InputError, match="no such file"):
        read_mesh(tmp_path)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.vtu", "this is not xml"),
        ("a.vtu", ""),
        ("a.vtu", "<VTKFile type='ImageData'/>"),
        ("a.vtk", "nonsense\n"),
        ("a.msh", "$MeshFormat\n"),
        ("a.inp", "*NODE\n1, a, b\n"),
        ("a.txt", "hello"),
        ("a", "hello"),
        ("a.nii.gz", "hello"),
    ],
)
def test_file_without_mesh_is_rejected(tmp_path: Path, name: str, text: str, capsys: pytest.CaptureFixture) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_mesh(path)
    assert str(caught.value).startswith(str(path))


def test_truncated_mesh_file_is_rejected(tmp_path: Path) -> None:
    path = write(tmp_path / "a.vtu")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match="cannot be read as a mesh"):
        read_mesh(path)


def test_unknown_unit_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'inch': choose one of m, mm"):
        read_mesh(write(tmp_path / "a.vtu"), "inch")


def test_mesh_output_without_vtu_suffix_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"written as \.vtu"):
        write_mesh(tmp_path / "a.vtk", MESH, {})
    assert list(tmp_path.iterdir()) == []


def test_mesh_output_creates_folder_without_partial_file(tmp_path: Path) -> None:
    write_mesh(tmp_path / "new" / "deep" / "a.vtu", MESH, {})
    assert [path.name for path in (tmp_path / "new" / "deep").iterdir()] == ["a.vtu"]


def test_failed_write_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.vtu"
    write_mesh(path, MESH, {})
    before = path.read_bytes()

    def fails(self: meshio.Mesh, target: Path) -> None:
        Path(target).write_text("half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(meshio.Mesh, "write", fails)
    with pytest.raises(InputError, match="No space left"):
        write_mesh(path, MESH, {})
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(("title", "signs"), [
    ("3D Slicer. SPACE=LPS", [-1, -1, 1]), ("mm;SPACE = lps", [-1, -1, 1]), ("SPACE=RAS", 1), ("FE space=H1", 1),
])  # fmt: skip
@pytest.mark.parametrize("form", ["vtk42", "vtk51"])
def test_vtk_in_lps_is_converted_with_a_note(tmp_path: Path, form: str, title: str, signs: list[int] | int) -> None:
    force = np.random.default_rng(2).normal(size=(len(MESH.nodes), 3))
    path = write(tmp_path / "a.vtk", form, points=CURVED.nodes * signs, cells=[("tetra10", CURVED.table)],
                 point_data={"force": np.resize(force, CURVED.nodes.shape) * signs})  # fmt: skip
    head, _, rest = path.read_bytes().split(b"\n", 2)
    path.write_bytes(b"\n".join([head, title.encode(), rest]))
    file = read_mesh(path)
    np.testing.assert_allclose(file.mesh.nodes, CURVED.nodes, atol=1e-15)
    np.testing.assert_array_equal(file.mesh.table, CURVED.table)
    np.testing.assert_array_equal(file.point_data["force"], np.resize(force, CURVED.nodes.shape))
    turned = "turned x and y of points and vectors from LPS, which its title states, to RAS"
    assert file.notes == (() if signs == 1 else (turned,))


def test_mesh_in_an_unknown_space_is_rejected(tmp_path: Path) -> None:
    path = write(tmp_path / "a.vtk")
    path.write_bytes(path.read_bytes().replace(b"written by meshio", b"SPACE=LAS"))
    with pytest.raises(InputError, match="title states SPACE=LAS: LPS or RAS is required"):
        read_mesh(path)
    path = write(tmp_path / "a.vtu")
    text = b'<FieldData><Array type="String" Name="SPACE" format="ascii">76 80 83 0</Array></FieldData>'
    path.write_bytes(path.read_bytes().replace(b"<UnstructuredGrid>", b"<UnstructuredGrid>" + text))
    with pytest.raises(InputError, match=r"array of text, .*: save it as \.vtk, whose title"):
        read_mesh(path)
