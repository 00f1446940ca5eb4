"""Arrays that a folder keeps while they are computed, so that a run that was stopped continues."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np

from sim.geometry.tetmesh import digest_of
from sim.runtime.atomic_files import written_whole
from sim.runtime.device import find_device
from sim.runtime.outside_files import read_as
from sim.runtime.versions import version_of

from .npz_archive import Archive

REMADE = "Delete it: it is made anew."
"""What to do about a kept file that is damaged."""


def kept_path(folder: Path | None, stem: str, device: str, *stated: object) -> Path | None:
    """Path of arrays that this version computes on a kind of device; None without a folder.

    `stated` is all else that decides their bytes, the element among it: each with a `repr` that tells it from others.
    """
    if folder is None:
        return None
    on = "cuda" if find_device(device, "float32").on_cuda else "cpu"
    key = repr((version_of("sulcus"), on, *stated))
    return folder / f"{stem}{digest_of(np.frombuffer(key.encode(), np.uint8))}.npz"


def kept_arrays(
    path: Path | None,
    kind: str,
    names: Iterable[str],
    make: Callable[[], Mapping[str, np.ndarray]],
    check: Callable[[Mapping[str, np.ndarray]], object] = lambda arrays: None,
) -> Mapping[str, np.ndarray]:
    """Arrays of some names from a file, if it is there; else they are made, and kept there. No path: only made.

    `kind` is what the file holds, with its article; `check` refuses arrays that were read.

    Raises
    ------
    InputError
        A file that cannot be read, or that the check refuses.
    """
    if path is not None and path.exists():
        with read_as(path, kind, REMADE), path.open("rb") as raw:
            found = Archive(raw, REMADE).arrays(names)
            check(found)
            return found
    made = make()
    if path is not None:
        with written_whole(path, ".npz") as unfinished:
            np.savez(unfinished, **made)  # pyright: ignore[reportArgumentType]
    return made
