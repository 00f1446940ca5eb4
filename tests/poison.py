"""Data sets whose answers to some loads are wild, as a file that nothing has damaged has them."""

from pathlib import Path

import h5py
import numpy as np

from surrogate.data.dataset import read_rows
from surrogate.data.solution_rows import compute_row_checksums


def poisoned(source: Path, target: Path, rows: np.ndarray, group: str = "answers") -> tuple[Path, np.ndarray]:
    """A copy of a data set with wild displacements (V, 3) [m] in some rows (numbers) of a group, and those."""
    target.write_bytes(source.read_bytes())
    with h5py.File(target, "r+") as file:
        stored = file[f"{group}/displacement"]
        wild = np.random.default_rng(0).normal(scale=1e-2, size=stored.shape[1:])
        for row in rows:
            stored[row] = wild
        whole, _ = read_rows(file, group, stored.shape[1], 0, len(stored))
        file[f"{group}/checksum"][:] = compute_row_checksums(whole)
    return target, wild
