"""Limits of input files, each at its boundary."""

import bz2
import resource
from pathlib import Path
from types import SimpleNamespace

import nibabel
import numpy as np
import pytest
from boxes import base_held, box
from limits import memory_below

from sim.bodies.meshfile import read_anatomy, write_mesh
from sim.bodies.volume import read_volume
from sim.errors import InputError
from sim.geometry.tetmesh import TetMesh
from sim.runtime.atomic_files import check_disk_space
from sim.runtime.file_limits import limit_memory

BODY = base_held(box((2, 2, 2), 0.02))


def test_memory_limit_is_relative_to_present_use() -> None:
    with limit_memory(2**28):
        assert np.ones(2**21).all()
    with pytest.raises(InputError, match=r"take more than 0\.268 GB"), limit_memory(2**28):
        np.ones(2**27)


def test_lower_memory_limit_set_before_is_kept() -> None:
    before = resource.getrlimit(resource.RLIMIT_AS)
    limit = 2**40
    try:
        resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
        with limit_memory(2**50):
            assert resource.getrlimit(resource.RLIMIT_AS)[0] == limit
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def test_unit_of_flat_body_is_checked_by_its_longest_side(tmp_path: Path) -> None:
    mesh = TetMesh(BODY.mesh.nodes * [1.0, 1.0, 0.2], BODY.mesh.tets, BODY.mesh.region)
    fields = {"held": BODY.fixed * 1, "slide_normal": np.zeros_like(mesh.nodes), "craniotomy": BODY.craniotomy * 1}
    write_mesh(tmp_path / "a.vtu", mesh, fields)
    assert np.ptp(mesh.nodes, axis=0).min() < 5e-3
    assert read_anatomy(tmp_path / "a.vtu").mesh.digest == mesh.digest


def test_file_larger_than_free_disk_space_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=2_000_000))
    check_disk_space(tmp_path / "a.h5", 1_900_000)
    with pytest.raises(InputError, match=r"needs 2\.1 MB, and the disk has 2\.0 MB left"):
        check_disk_space(tmp_path / "a.h5", 2_100_000)


def volume(path: Path, edges: tuple[float, ...] = (1.0, 1.0, 1.0), unit: str = "mm", shift: float = 0.0) -> Path:
    image = nibabel.Nifti1Image(np.ones((6, 6, 6), np.uint8), np.diag([*edges, 1.0]))
    image.header.set_xyzt_units(unit)
    image.set_sform(image.affine, 1)
    moved = np.array(image.affine)
    moved[0, 3] += shift
    image.set_qform(moved, 1)
    nibabel.save(image, path)
    return path


def test_truncated_nifti_volume_is_rejected(tmp_path: Path) -> None:
    path = volume(tmp_path / "a.nii")
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match=r"ends after 567 of 568 bytes"):
        read_volume(path)


def test_volume_with_one_coarse_axis_is_rejected(tmp_path: Path) -> None:
    assert read_volume(volume(tmp_path / "a.nii", (1.0, 1.0, 5.9))).values.shape == (6, 6, 6)
    with pytest.raises(InputError, match=r"1 x 1 x 6\.1"):
        read_volume(volume(tmp_path / "b.nii", (1.0, 1.0, 6.1)))


@pytest.mark.parametrize(("unit", "millimetres"), [("unknown", 1.0), ("mm", 1.0), ("meter", 1e3), ("micron", 1e-3)])
def test_nifti_lengths_use_the_unit_of_the_header(tmp_path: Path, unit: str, millimetres: float) -> None:
    edge = 1.0 / millimetres
    found = read_volume(volume(tmp_path / "a.nii", (edge, edge, edge), unit, 3.0 / millimetres))
    np.testing.assert_allclose(np.diag(found.affine)[:3], 1e-3, rtol=1e-6)
    assert "up to 3 mm apart" in " ".join(found.notes)


@pytest.mark.parametrize("kind", ["uchar", "double"])
def test_bzip2_nrrd_of_a_few_bytes_is_rejected_unread(tmp_path, kind):
    """Few bytes may hold half a billion zeros: the sizes of header and file are compared before reading."""
    header = f"""NRRD0004
type: {kind}
dimension: 3
space: right-anterior-superior
sizes: 1024 1024 512
space directions: (1,0,0) (0,1,0) (0,0,1)
space origin: (0,0,0)
endian: little
encoding: bzip2

"""
    (tmp_path / "b.nrrd").write_bytes(header.encode() + 100 * bz2.compress(bytes(2**20)))
    with memory_below(2**22), pytest.raises(InputError, match="is too short for its"):
        read_volume(tmp_path / "b.nrrd")
