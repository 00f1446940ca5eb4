"""NRRD headers with voxels in a separate file (`.nhdr`)."""

import nrrd as reference
import numpy as np
import pytest
from test_sim_head_masks import grid, head, nrrd

from sim.bodies.volume import read_volume
from sim.errors import InputError


@pytest.mark.parametrize("coding", ["gzip", "raw"])
def test_separate_voxel_file_of_nrrd_header_is_read(tmp_path, coding):
    """Written by pynrrd; truncated, of another size or missing, it is rejected with the header's path."""
    affine, places = grid(count=12, edge=6.0)
    whole = read_volume(nrrd(tmp_path / "a.nrrd", head(places), affine))
    values, header = reference.read(str(tmp_path / "a.nrrd"))
    path = tmp_path / "b.nhdr"
    reference.write(str(path), values, {**header, "encoding": coding}, detached_header=True)
    (beside,) = (one for one in tmp_path.iterdir() if one.name.startswith("b.") and one != path)
    found = read_volume(path)
    np.testing.assert_array_equal(found.values, whole.values)
    np.testing.assert_allclose(found.affine, whole.affine, atol=1e-12)
    text, voxels = path.read_bytes(), beside.read_bytes()
    path.write_bytes(text.rstrip(b"\n") + b"\n")  # a header of its own may end with its file
    np.testing.assert_array_equal(read_volume(path).values, whole.values)
    for header_now, voxels_now, reason in (
        (text, voxels[: len(voxels) // 2], "ends|too short"),
        (text.replace(b"sizes: 12 12 12", b"sizes: 12 12 13"), voxels, "ends after|too short"),
        (text.replace(b"sizes: 12 12 12", b"sizes: 800 800 800"), voxels, "is too short for its"),
        (text, None, "no such file is in the same folder"),
    ):
        path.write_bytes(header_now)
        beside.unlink() if voxels_now is None else beside.write_bytes(voxels_now)
        with pytest.raises(InputError, match=reason) as error:
            read_volume(path)
        assert str(error.value).startswith(str(path))
