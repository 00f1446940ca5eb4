"""Mesh files that refer to other files, declare more data than they hold, or have a format whose reader never ends."""

from pathlib import Path

import h5py
import meshio
import numpy as np
import pytest
from boxes import base_held, box

from sim.bodies.meshfile import read_mesh
from sim.errors import InputError
from sim.runtime.file_limits import MeshSizeLimits

BODY = base_held(box((2, 2, 2), 0.02))


@pytest.mark.parametrize("name", ["a.mdpa", "a.tec", "a.dat", "a.node", "a.vol.gz", "a.stl", "a"])
def test_formats_with_endless_readers_are_rejected(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"Begin Nodes\n")
    with pytest.raises(InputError, match=r"no mesh is read from .*: give a tetrahedral mesh as \.vtu, \.vtk"):
        read_mesh(tmp_path / name)


@pytest.mark.parametrize("word", ["*INCLUDE", " *Include"])
def test_mesh_that_includes_another_file_is_rejected(tmp_path: Path, word: str) -> None:
    meshio.Mesh(BODY.mesh.nodes, [("tetra", BODY.mesh.tets)]).write(tmp_path / "b.inp")
    (tmp_path / "a.inp").write_text(f"*HEADING\n{word}, INPUT={tmp_path}/b.inp\n")
    with pytest.raises(InputError, match=r"it includes another file\. Merge both into one file"):
        read_mesh(tmp_path / "a.inp")


@pytest.mark.parametrize("way", ["over", "absolute", "link", "binary", "missing"])
def test_xdmf_reference_outside_its_folder_is_rejected(tmp_path: Path, way: str) -> None:
    path, away = tmp_path / "in/a.xdmf", tmp_path / "a.h5"
    path.parent.mkdir()
    meshio.Mesh(BODY.mesh.nodes, [("tetra", BODY.mesh.tets)]).write(path)
    assert read_mesh(path).mesh.digest == BODY.mesh.digest
    path.with_suffix(".h5").replace(away)
    if way == "link":
        path.with_suffix(".h5").symlink_to(away)
    there = {"over": "../a.h5:", "absolute": f"{away}:"}.get(way, "a.h5:")
    text = path.read_text().replace("a.h5:", there)
    path.write_text(text.replace('"HDF"', '"Binary"') if way == "binary" else text)
    words = {"binary": "are of the format Binary", "missing": "refers to a.h5, which is not there"}
    with pytest.raises(InputError, match=words.get(way, rf"refers to {there[:-1]}, outside of its folder")):
        read_mesh(path)


@pytest.mark.parametrize("way", ["external link", "soft link", "external", "virtual", "declared"])
@pytest.mark.parametrize("name", ["a.xdmf", "a.hmf"])
def test_hdf5_mesh_with_external_arrays_is_rejected(tmp_path: Path, name: str, way: str) -> None:
    path = tmp_path / name
    meshio.Mesh(BODY.mesh.nodes, [("tetra", BODY.mesh.tets)]).write(path)
    assert read_mesh(path).mesh.digest == BODY.mesh.digest
    other, shape = tmp_path / "other.h5", BODY.mesh.nodes.shape
    with h5py.File(other, "w") as file:
        file["x"] = BODY.mesh.nodes
    BODY.mesh.nodes.tofile(tmp_path / "other.bin")
    with h5py.File(path.with_suffix(".h5") if name == "a.xdmf" else path, "r+") as file:
        place: list[str] = []
        file.visititems(lambda key, item: place.append(key) if getattr(item, "shape", None) == shape else None)
        del file[place[0]]
        if way == "external link":
            file[place[0]] = h5py.ExternalLink(str(other), "/x")
        if way == "soft link":
            file["moved"] = BODY.mesh.nodes
            file[place[0]] = h5py.SoftLink("/moved")
        if way == "external":
            file.create_dataset(place[0], shape, "f8", external=[(str(tmp_path / "other.bin"), 0, 8 * 81)])
        if way == "virtual":
            layout = h5py.VirtualLayout(shape, "f8")
            layout[:] = h5py.VirtualSource(str(other), "x", shape)
            file.create_virtual_dataset(place[0], layout)
        if way == "declared":  # chunks that are missing are zeros
            file.create_dataset(place[0], (100_000_000, 3), "f8", chunks=(100_000, 3))
    words = {"external": "lies in another file", "virtual": "lies in another file", "declared": "more than it holds"}
    with pytest.raises(InputError, match=words.get(way, "is a link of .* to another place")):
        read_mesh(path)


def test_hdf5_mesh_larger_than_allowed_ratio_is_rejected(tmp_path: Path) -> None:
    path, few = tmp_path / "a.xdmf", MeshSizeLimits(max_ratio=2, min_limit=2**10)
    meshio.Mesh(BODY.mesh.nodes, [("tetra", BODY.mesh.tets)]).write(path)
    with h5py.File(path.with_suffix(".h5"), "r+") as file:
        file["more"] = np.random.default_rng(0).random(400_000)  # 3.2 MB, far more than the XML
    assert read_mesh(path, limits=few).mesh.digest == BODY.mesh.digest
    with h5py.File(path.with_suffix(".h5"), "r+") as file:
        for number in range(3):
            file.create_dataset(f"zeros{number}", (400_000,), "f8", compression="gzip")[:] = 0.0
    with pytest.raises(InputError, match="take more than"):
        read_mesh(path, limits=few)
