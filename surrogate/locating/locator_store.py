"""Locators of patients, computed once before surgery, and stored in files that are read within a second."""

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from sim.anatomy import Anatomy
from sim.effects import SKULLS
from sim.errors import InputError
from sim.runtime.atomic_files import write_atomically
from sim.runtime.outside_files import wrap_errors
from sim.runtime.threads import limit_to_one_thread
from sim.runtime.versions import get_version

from ..model.npz_archive import Archive, compute_seal
from .calibration import TRIAL_COUNT, run_trials
from .causes import KINDS, USUAL_CAUSES, Causes, solve_presses
from .ensemble import solve_groups
from .locator import Locator
from .prior import NO_PLACE, TOOL_SKULLS, MotionPrior, build_prior
from .regions import Region, check_regions

FORMAT = "sulcus locator 6"  # Name and version of the file format.
REMEDY = "Move it away, and `sulcus locate` makes it again."  # Remedy in error messages.
NUMBER_ARRAYS = ("kind", "skull", "place")  # Arrays of numbers of causes, skulls and places, one per shape.
ARRAYS = ("shape", *NUMBER_ARRAYS, "centre")  # Arrays of a file with the whole brain's shapes.


def to_locator_path(anatomy: str | Path) -> Path:
    """Return the path of an anatomy's locator: MESH.locator.npz, next to MESH.vtu."""
    return Path(anatomy).with_suffix(".locator.npz")


def save_locator(path: str | Path, locator: Locator) -> None:
    """Write a locator to an .npz file, atomically.

    Raises
    ------
    InputError
        The name does not end in .npz, or the folder is not writable.
    """
    prior = locator.prior
    header = {
        "format": FORMAT, "anatomy": prior.anatomy.digest, "version": get_version("sulcus"), "kinds": KINDS,
        "whole": prior.nodes is None, "space": "RAS [m]", "regions": [asdict(one) for one in locator.regions],
    }  # fmt: skip
    arrays = {name: getattr(prior, name) for name in _list_array_names(header)} | {"tried": locator.tried}
    header["seal"] = compute_seal(header, arrays)
    with write_atomically(path, ".npz") as unfinished:
        np.savez(unfinished, header=np.array(json.dumps(header)), **arrays)  # pyright: ignore[reportArgumentType]


def load_locator(path: str | Path, anatomy: Anatomy) -> Locator:
    """Read the locator of an anatomy from a file.

    Raises
    ------
    InputError
        The file is missing, of another version, damaged, or for another anatomy.
    """
    with wrap_errors(path, "a locator", REMEDY), Path(path).open("rb") as raw:
        archive = Archive(raw, REMEDY)
        header = json.loads(archive.read_text("header"))
        if header["format"] != FORMAT or tuple(header["kinds"]) != KINDS:
            raise InputError(f"{path}: is no locator of this version. {REMEDY}")
        if header["anatomy"] != anatomy.digest:
            raise InputError(f"{path}: was made for another anatomy: give that one, or another locator.")
        regions = tuple(Region(**one) for one in header.get("regions", ()))
        check_regions(regions, anatomy)
        arrays = archive.read_sealed(header, [*_list_array_names(header), "tried"])
        _check_prior(path, anatomy, arrays)
        tried = arrays.pop("tried")
        return Locator(MotionPrior(anatomy, **arrays), tried, regions)


def _list_array_names(header: dict[str, Any]) -> tuple[str, ...]:
    """Return the names of a prior's arrays, for a file with all vertices or with some of them."""
    return ARRAYS if header.get("whole", True) else (*ARRAYS, "nodes")


def _check_prior(path: str | Path, anatomy: Anatomy, arrays: dict[str, np.ndarray]) -> None:
    """Raise InputError if the arrays of a file do not fit the anatomy or each other."""
    shape, tried, every = arrays["shape"], arrays["tried"], np.arange(len(anatomy.mesh.nodes))
    nodes = arrays.get("nodes", every)
    fits = nodes.dtype.kind == "i" and np.array_equal(nodes, np.intersect1d(nodes, every))
    fits = fits and shape.ndim == 3 and shape.shape[1:] == (len(nodes), 3) and tried.ndim == 2 and tried.shape[1] == 5
    fits = fits and all(arrays[name].shape == (len(shape),) for name in NUMBER_ARRAYS) and len(shape) and len(tried)
    fits = fits and arrays["centre"].ndim == 2 and arrays["centre"].shape[1] == 3
    limits = ((0, len(KINDS)), (0, len(SKULLS)), (NO_PLACE, len(arrays["centre"])))
    for name, (low, high) in zip(NUMBER_ARRAYS, limits, strict=True):
        fits = fits and arrays[name].dtype.kind == "i" and arrays[name].min() >= low and arrays[name].max() < high
    if not fits or not all(np.isfinite(arrays[name]).all() for name in ("shape", "centre", "tried")):
        raise InputError(f"{path}: has arrays that do not fit the anatomy. {REMEDY}")


def make_locator(
    anatomy: Anatomy, seed: int = 0, device: str = "auto", causes: Causes = USUAL_CAUSES, folder: Path | None = None,
    progress: Callable[[str, int, int], object] = lambda stage, done, total: None, count: int = TRIAL_COUNT,
) -> Locator:  # fmt: skip
    """Build the locator of an anatomy; finished groups of an interrupted run are read from `folder`.

    The locator keeps the known regions in `causes`. `progress` receives a stage, the number of its parts done, and
    their total. `count` is the number of trials that calibrate the locator.

    Raises
    ------
    InputError
        The anatomy has no open cortex, tumour or skull, or lacks a region in `causes`; no member of a group has
        converged.
    """
    check_regions(causes.regions, anatomy)
    ensemble = solve_groups(anatomy, seed, device, causes, folder, lambda done, total: progress("causes", done, total))
    progress("forces on the cortex", 0, 1)
    presses = solve_presses(anatomy, tuple(dict.fromkeys(TOOL_SKULLS.values())), device, causes.regions)
    with limit_to_one_thread():  # matrix products are small
        tried = run_trials(ensemble, presses, lambda done, total: progress("trials", done, total), count)
    return Locator(build_prior(ensemble, presses), tried, causes.regions)
