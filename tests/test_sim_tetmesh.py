"""Meshes and anatomies: rejected input, warnings, and identity by digest."""

import warnings

import numpy as np
import pytest
from boxes import base_held, box, hold

from sim.anatomy import Anatomy
from sim.errors import InputError
from sim.geometry.tetmesh import (
    MeshWarning,
    TetMesh,
    compute_dihedral_angles,
    compute_signed_volumes,
    find_boundary_faces,
    orient_tetrahedra,
)

CORNERS = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]])
ONE = np.array([[0, 1, 2, 3]])


def changed(**fields: np.ndarray) -> TetMesh:
    return TetMesh(**({"nodes": CORNERS, "tets": ONE, "region": np.zeros(1, int)} | fields))


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"nodes": np.where(np.eye(4, 3, dtype=bool), np.nan, CORNERS)}, r"node 0 has the coordinates .*finite"),
        ({"nodes": np.where(np.eye(4, 3, k=-1, dtype=bool), np.inf, CORNERS)}, r"node 1 has the coordinates"),
        ({"nodes": CORNERS[:, :2]}, r"nodes have shape \(4, 2\)"),
        ({"tets": ONE[:, :3]}, r"tets have shape \(1, 3\)"),
        ({"tets": np.zeros((0, 4), int)}, r"tets have shape \(0, 4\).*at least one"),
        ({"tets": np.array([[0, 1, 2, 4]])}, "name node 4, but the mesh has nodes 0 to 3"),
        ({"tets": np.array([[0, 1, 2, -1]])}, "name node -1"),
        ({"region": np.zeros(2, int)}, r"region has shape \(2,\)"),
        ({"tets": np.array([[0, 2, 1, 3]])}, "tetrahedron 0 .*zero or negative.*`orient_tetrahedra`"),
        ({"nodes": CORNERS * [1.0, 1.0, 0.0]}, "zero or negative"),
        ({"tets": np.array([[0, 1, 2, 2]])}, "zero or negative"),
    ],
)
def test_bad_meshes_are_rejected(fields: dict, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        changed(**fields)


@pytest.mark.parametrize(("scale", "unit"), [(0.009, "m if it has metres"), (101.0, "mm if it has millimetres")])
def test_doubtful_mesh_size_causes_a_warning(scale: float, unit: str) -> None:
    with pytest.warns(MeshWarning, match=f"Read it with unit {unit}"):
        changed(nodes=scale * CORNERS)


def test_unused_nodes_do_not_count_for_the_size() -> None:
    changed(nodes=np.vstack([CORNERS, [[500.0, 0.0, 0.0]]]))


def test_slivers_cause_a_warning() -> None:
    with pytest.warns(MeshWarning, match="1 tetrahedra have a dihedral angle below 1 degree"):
        changed(nodes=np.where(CORNERS == 0.1, [0.1, 0.1, 0.001], 0.0))


def test_good_mesh_causes_no_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        changed()


def test_mirrored_tetrahedra_are_reoriented_to_same_volume() -> None:
    mesh = box((3, 2, 4), 0.2, distortion=0.2)
    assert mesh.volumes.sum() == pytest.approx(0.15 * 0.1 * 0.2)
    mirrored = mesh.nodes * [-1.0, 1.0, 1.0]
    np.testing.assert_allclose(compute_signed_volumes(mirrored, mesh.tets), -mesh.volumes)
    turned, count = orient_tetrahedra(mirrored, mesh.tets)
    assert count == len(mesh.tets)
    assert TetMesh(mirrored, turned, mesh.region).volumes.sum() == pytest.approx(mesh.volumes.sum())
    same, none = orient_tetrahedra(mesh.nodes, mesh.tets)
    assert none == 0
    np.testing.assert_array_equal(same, mesh.tets)


def test_surface_is_closed_and_points_outwards() -> None:
    mesh = box((3, 2, 4), 0.2, distortion=0.2)
    corners = mesh.nodes[mesh.surface]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2.0
    np.testing.assert_allclose(area.sum(axis=0), 0.0, atol=1e-15)
    # Divergence theorem: the flux of x is three times the volume, with the sign of the normals.
    assert np.einsum("si,si->", area, corners.mean(axis=1)) == pytest.approx(3.0 * mesh.volumes.sum())
    assert len(mesh.surface) == 2 * 2 * (3 * 2 + 2 * 4 + 3 * 4)


def test_boundary_of_an_inner_region_is_found() -> None:
    mesh = box((4, 4, 4), 0.1)
    inner = (np.abs(mesh.nodes[mesh.tets].mean(axis=1) - 0.05) < 0.025).all(axis=1)
    mesh = TetMesh(mesh.nodes, mesh.tets, np.where(inner, 2, 1))
    assert len(mesh.find_boundary(2)) == 2 * 6 * 4
    assert len(mesh.find_nodes(2)) == 27
    np.testing.assert_array_equal(np.unique(mesh.find_boundary(2)), np.setdiff1d(mesh.find_nodes(2), _centre(mesh)))
    assert len(find_boundary_faces(mesh.tets)) == len(mesh.surface)


def _centre(mesh: TetMesh) -> np.ndarray:
    return np.flatnonzero(np.linalg.norm(mesh.nodes - 0.05, axis=1) < 1e-9)


def test_dihedral_angles_of_known_tetrahedra_are_exact() -> None:
    np.testing.assert_allclose(
        np.sort(compute_dihedral_angles(CORNERS, ONE)[0]), [np.degrees(np.arccos(1.0 / np.sqrt(3.0)))] * 3 + [90.0] * 3
    )
    regular = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
    np.testing.assert_allclose(compute_dihedral_angles(regular, ONE), np.degrees(np.arccos(1.0 / 3.0)))


def test_mesh_arrays_are_read_only() -> None:
    mesh = changed()
    with pytest.raises(ValueError, match="read-only"):
        mesh.nodes[0, 0] = 1.0


def test_mesh_copies_the_arrays_of_its_caller() -> None:
    nodes = CORNERS.copy()
    mesh = changed(nodes=nodes)
    nodes[3, 2] = 0.5
    assert mesh.nodes[3, 2] == 0.1


def test_digest_is_stable() -> None:
    """The value is written into data sets and models: it must not change between machines or versions."""
    mesh = changed()
    assert mesh.digest == changed().digest
    assert mesh.digest == changed(nodes=CORNERS.astype(">f8"), tets=ONE.astype(np.int64)).digest
    assert mesh.digest == "96753bb6dc5a3880"


@pytest.mark.parametrize(
    "fields",
    [
        {"nodes": CORNERS + np.array([0.0, 0.0, 1e-16]) * (CORNERS == 0.1)},
        {"nodes": np.vstack([CORNERS, [[0.0, 0.0, 0.0]]])},
        {"tets": np.array([[1, 2, 0, 3]])},
        {"region": np.ones(1, int)},
    ],
)
def test_digest_depends_on_every_bit(fields: dict) -> None:
    other = changed(**fields)
    assert any(not np.array_equal(getattr(other, name), getattr(changed(), name)) for name in fields)
    assert other.digest != changed().digest


class TestAnatomy:
    def test_digest_depends_on_the_constraints(self) -> None:
        mesh = changed()
        base = hold(mesh, np.zeros(4, bool))
        held = hold(mesh, np.eye(4, 3, dtype=bool))
        normal = hold(mesh, np.zeros(4, bool), np.eye(4, 3))
        opened = Anatomy(mesh, base.fixed, base.slide_normal, np.ones(4, bool))
        assert len({base.digest, held.digest, normal.digest, opened.digest, mesh.digest}) == 5

    @pytest.mark.parametrize(
        ("held", "normal", "opened", "sentence"),
        [
            (np.zeros((4, 2)), np.zeros((4, 3)), np.zeros(4), r"fixed has shape \(4, 2\)"),
            (np.zeros((4, 3)), np.zeros((3, 3)), np.zeros(4), r"slide_normal has shape"),
            (np.zeros((4, 3)), np.zeros((4, 3)), np.zeros(5), r"craniotomy has shape"),
            (np.zeros((4, 3)), np.full((4, 3), 0.5), np.zeros(4), "normalise"),
            (np.zeros((4, 3)), np.full((4, 3), np.nan), np.zeros(4), "normalise"),
        ],
    )
    def test_anatomy_with_inconsistent_arrays_is_rejected(
        self, held: np.ndarray, normal: np.ndarray, opened: np.ndarray, sentence: str
    ) -> None:
        with pytest.raises(InputError, match=sentence):
            Anatomy(changed(), held, normal, opened)

    def test_open_surface_has_all_corners_in_the_craniotomy(self) -> None:
        mesh = box((3, 3, 3), 0.1)
        top = mesh.nodes[:, 2] > 0.1 - 1e-9
        anatomy = Anatomy(mesh, base_held(mesh).fixed, np.zeros((64, 3)), top)
        assert len(anatomy.open_surface) == 18
        assert top[anatomy.open_surface].all()
