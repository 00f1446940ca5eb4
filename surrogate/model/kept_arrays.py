"""Cache of computed arrays in a folder, from which an interrupted run resumes."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np

from sim.geometry.tetmesh import compute_digest
from sim.runtime.atomic_files import write_atomically
from sim.runtime.device import find_device
from sim.runtime.outside_files import wrap_errors
from sim.runtime.versions import get_version

from .npz_archive import Archive

REMEDY = "Delete it: it is computed again."
"""Remedy in the error message for a damaged cache file."""


def get_cache_path(folder: Path | None, stem: str, device: str, *inputs: object) -> Path | None:
    """Return the cache path of arrays that this version computes on a device type (CPU or CUDA); None without a folder.

    `inputs` lists all other inputs that determine the arrays, including the element. Each has a distinctive `repr`.
    """
    if folder is None:
        return None
    on = "cuda" if find_device(device, "float32").on_cuda else "cpu"
    key = repr((get_version("sulcus"), on, *inputs))
    return folder / f"{stem}{compute_digest(np.frombuffer(key.encode(), np.uint8))}.npz"


def load_cached_arrays(
    path: Path | None, description: str, names: Iterable[str], compute: Callable[[], Mapping[str, np.ndarray]],
    check: Callable[[Mapping[str, np.ndarray]], object] = lambda arrays: None,
) -> Mapping[str, np.ndarray]:  # fmt: skip
    """Read arrays by name from a file if it exists, else compute and store them. Without a path, only compute them.

    `description` names the file's content, with an article, for error messages. `check` raises for invalid arrays.

    Raises
    ------
    InputError
        The file cannot be read, or `check` rejects its arrays.
    """
    if path is not None and path.exists():
        with wrap_errors(path, description, REMEDY), path.open("rb") as raw:
            found = Archive(raw, REMEDY).read_arrays(names)
            check(found)
            return found
    made = compute()
    if path is not None:
        with write_atomically(path, ".npz") as unfinished:
            np.savez(unfinished, **made)  # pyright: ignore[reportArgumentType]
    return made
