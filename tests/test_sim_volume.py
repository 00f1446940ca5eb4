"""Voxel volumes of input files: bounded memory, and a message for every defect."""

import gzip
import struct
from pathlib import Path

import nibabel
import numpy as np
import pytest
from limits import memory_below

from sim.bodies.intensity import read_intensity
from sim.bodies.volume import read_volume
from sim.errors import InputError


def volume(path: Path, shape: tuple[int, ...] = (6, 6, 6), edge: float = 1.0) -> Path:
    image = nibabel.Nifti1Image(np.ones(shape, np.uint8), np.diag([edge, edge, edge, 1.0]))
    nibabel.save(image, path)
    return path


def header_with(path: Path, place: int, form: str, *values: float) -> Path:
    """A .nii or .nii.gz with other numbers in its header."""
    packed = path.name.endswith(".gz")
    raw = bytearray(gzip.decompress(path.read_bytes()) if packed else path.read_bytes())
    struct.pack_into(form, raw, place, *values)
    path.write_bytes(gzip.compress(bytes(raw)) if packed else bytes(raw))
    return path


class TestVolumes:
    @pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
    def test_truncated_volume_is_rejected_before_allocation(self, tmp_path: Path, name: str) -> None:
        path = header_with(volume(tmp_path / name), 40, "<4h", 3, 700, 700, 700)
        with memory_below(2**24), pytest.raises(InputError, match=r"ends after 568 of 343,000,352 bytes"):
            read_volume(path)

    def test_volume_above_the_size_limit_is_rejected(self, tmp_path: Path) -> None:
        path = header_with(volume(tmp_path / "a.nii.gz"), 40, "<4h", 3, 1600, 1600, 1600)
        with pytest.raises(InputError, match=r"4\.1e\+09 voxels; the maximum is 5\.37e\+08"):
            read_volume(path)

    @pytest.mark.parametrize("numbers", [(np.nan, 0.0), (-np.inf, 0.0)])
    def test_volume_with_non_finite_slope_is_rejected(self, tmp_path: Path, numbers: tuple[float, float]) -> None:
        with pytest.raises(InputError, match=r"slope .* which are no numbers"):
            read_volume(header_with(volume(tmp_path / "a.nii"), 112, "<2f", *numbers))

    def test_volume_with_tiny_voxels_is_rejected(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match=r"measure 1e-20 mm along an axis; 0\.01 mm is the least"):
            read_volume(volume(tmp_path / "a.nii", edge=1e-20))
        assert read_volume(volume(tmp_path / "b.nii", edge=0.1)).values.shape == (6, 6, 6)

    def test_damaged_volume_is_rejected_with_its_path(self, tmp_path: Path) -> None:
        whole = volume(tmp_path / "a.nii.gz", (20, 20, 20)).read_bytes()
        for place in range(0, len(whole), 7):
            path = tmp_path / "b.t1.nii.gz"
            path.write_bytes(whole[:place] + bytes([whole[place] ^ 255]) + whole[place + 1 :])
            try:
                read_intensity(path)
            except InputError as error:
                assert str(error).startswith(str(path)) and "Error -" not in str(error)
