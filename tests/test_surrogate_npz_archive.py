"""Archives of arrays: size limits before allocation."""

import zipfile

import numpy as np
import pytest
from limits import memory_below

from sim.errors import InputError
from surrogate.model.npz_archive import Archive


def test_arrays_above_the_size_limit_are_rejected(tmp_path):
    np.savez_compressed(tmp_path / "m.npz", few=np.zeros(10), many=np.zeros(1000))
    with (tmp_path / "m.npz").open("rb") as raw:
        for most, name, count in ((1000, "few", 10), (8200, "many", 1000)):  # less than both with their heads
            archive = Archive(raw, max_bytes=most)
            assert len(archive.read_arrays([name])[name]) == count
            with pytest.raises(InputError, match="MB are the most"):
                archive.read_arrays(["few", "many"])


def test_oversized_array_is_rejected_before_allocation(tmp_path):
    """The file holds fewer bytes than its header declares."""
    np.savez(tmp_path / "m.npz", many=np.zeros(2**20))
    with zipfile.ZipFile(tmp_path / "m.npz") as source:
        raw = source.read("many.npy")
    with zipfile.ZipFile(tmp_path / "n.npz", "w") as target:
        target.writestr("many.npy", raw[: 128 + 2**21])
    wrong = pytest.raises(InputError, match="is not what it says")
    with memory_below(2**20), (tmp_path / "n.npz").open("rb") as file, wrong:
        Archive(file).read_arrays(["many"])
