"""What lies beside a mesh and was made with it: data and models, which refuse every other mesh."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path

from sim.errors import InputError
from sim.runtime.journal import run_of
from sim.runtime.partial_files import unfinished_path

# What of a data set must stay as it was for a run to go on with it.
KEPT = ("anatomy", "effects", "tissue", "element", "accuracy", "preset", "seed", "shape")


def stated(path: Path) -> dict[str, str]:
    """What a data set, an unfinished one, or a model file says of itself as texts; nothing where none can be read."""
    import h5py

    from surrogate.model.npz_archive import Archive

    try:
        if path.suffix == ".npz":
            with path.open("rb") as raw:
                return {name: str(value) for name, value in json.loads(Archive(raw).text("header")).items()}
        if h5py.is_hdf5(path):
            with h5py.File(path, "r") as file:
                return {name: str(value) for name, value in file.attrs.items()}
        return run_of(path)
    except (OSError, ValueError, LookupError, AttributeError, zipfile.BadZipFile):
        return {}


def strangers(mesh: Path, digest: str) -> list[Path]:
    """Data and models beside a mesh file, by their names, that were made with an anatomy of another `digest`."""
    from ..play.deformers import model_path  # takes seconds, and whoever only simulates needs none of it

    data = mesh.with_suffix(".h5")
    beside = (data, unfinished_path(data), model_path(mesh))
    return [path for path in beside if path.is_file() and stated(path).get("anatomy", digest) != digest]


def demand_no_strangers(mesh: Path, digest: str, force: bool) -> list[Path]:
    """Those `strangers`, which `force` accepts.

    Raises
    ------
    InputError
        Without `force`, where there is one.
    """
    found = strangers(mesh, digest)
    if found and not force:
        raise InputError(
            f"{mesh}: would be another anatomy than the one that {' and '.join(path.name for path in found)} beside it "
            "belong to. Repeat the first command, choose another --out, or give --force to replace them."
        )
    return found


def remove_data(path: Path, wanted: Mapping[str, str]) -> None:
    """Remove a data set, and an unfinished one of its name, that cannot go on as what is `wanted`; keep others."""
    for each in (path, unfinished_path(path)):
        found = stated(each)
        if any(found.get(name) != wanted.get(name) for name in KEPT):
            each.unlink(missing_ok=True)


def batch_begun(path: Path) -> int | None:
    """The batch of a data set that is there, or begun, and that goes on with it; None where none can be read."""
    for each in (path, unfinished_path(path)):
        found = stated(each).get("batch", "")
        if found.isdigit():
            return int(found)
    return None
