"""Mesh files that refer to other files, declare what they do not hold, or are of a format that is read for ever."""

from pathlib import Path

import h5py
import meshio
import pytest
from boxes import base_held, box

from sim.bodies.meshfile import read_mesh
from sim.errors import InputError

BODY = base_held(box((2, 2, 2), 0.02))


@pytest.mark.parametrize("name", ["a.mdpa", "a.tec", "a.dat", "a.node", "a.vol.gz", "a.stl", "a"])
def test_formats_that_may_be_read_for_ever_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"Begin Nodes\n")
    with pytest.raises(InputError, match=r"no mesh is read from .*: give a tetrahedral mesh as \.vtu, \.vtk"):
        read_mesh(tmp_path / name)


@pytest.mark.parametrize("word", ["*INCLUDE", " *Include"])
def test_a_mesh_includes_no_other_file(tmp_path: Path, word: str) -> None:
    meshio.Mesh(BODY.mesh.nodes, [("tetra", BODY.mesh.tets)]).write(tmp_path / "b.inp")
    (tmp_path / "a.inp").write_text(f"*HEADING\n{word}, INPUT={tmp_path}/b.inp\n")
    with pytest.raises(InputError, match=r"it includes another file\. Merge both into one file"):
        read_mesh(tmp_path / "a.inp")


@pytest.mark.parametrize("way", ["over", "absolute", "link", "binary", "missing"])
def test_xdmf_refers_to_its_own_folder_alone(tmp_path: Path, way: str) -> None:
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


@pytest.mark.parametrize("name", ["a.xdmf", "a.hmf"])
def test_hdf5_that_declares_more_than_it_holds_is_rejected(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    meshio.Mesh(BODY.mesh.nodes, [("tetra", BODY.mesh.tets)]).write(path)
    assert read_mesh(path).mesh.digest == BODY.mesh.digest
    with h5py.File(path.with_suffix(".h5") if name == "a.xdmf" else path, "r+") as file:
        place: list[str] = []
        shape = BODY.mesh.nodes.shape
        file.visititems(lambda key, item: place.append(key) if getattr(item, "shape", None) == shape else None)
        del file[place[0]]
        file.create_dataset(place[0], (100_000_000, 3), "f8", chunks=(100_000, 3))  # missing chunks are zeros
    with pytest.raises(InputError, match=r"take more than 1\.07 GB|it is damaged"):
        read_mesh(path)
