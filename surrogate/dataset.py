"""Data sets: loads, the displacement of every vertex, and where they come from. HDF5, SI units, RAS.

Layout: `anatomy/` the body; `loads/CAUSE/` the arrays of each cause; `answers/` and `unit/`, each with `displacement`
(n, V, 3) float32 [m], `outcome`, `iterations`, `residual`, `done`. `answers/` belongs to `loads/`; `unit/` holds the
small-strain response [m/N] to a unit force at every node `unit/node` of the open cortex, along x, y and z in turn; of
data of poses there is none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

import h5py
import numpy as np

from sim.anatomy import Anatomy
from sim.deformation import Outcome
from sim.errors import InputError
from sim.loads import Cause, Displaced, Loads, Nodal, Posture, Prescribed, Pushed, Touching
from sim.mesh import TetMesh

CAUSES: dict[str, type[Cause]] = {
    kind.__name__: kind for kind in (Pushed, Displaced, Nodal, Prescribed, Posture, Touching)
}
FORMAT = "sulcus data 1"
# The arrays of a mesh; linear ones have no `middles`.
MESH = ("nodes", "tets", "region", "middles")
# Rows read at once when only some vertices are wanted.
CHUNK = 256


@dataclass(frozen=True, eq=False)
class Dataset:
    """A finished data set; displacements stay in the file until they are asked for.

    Parameters
    ----------
    path
        The HDF5 file.
    anatomy
        The body that was deformed.
    loads
        n load cases.
    outcome
        n outcomes; the rows of failed cases hold no equilibrium under the whole load.
    iterations, residual
        (n,).
    unit_good
        (3 m,) bool: the unit responses that converged.
    provenance
        Effects, accuracy, preset, seed, versions: as text.
    """

    path: Path
    anatomy: Anatomy
    loads: Loads
    outcome: tuple[Outcome, ...]
    iterations: np.ndarray
    residual: np.ndarray
    unit_good: np.ndarray
    provenance: Mapping[str, str]

    @property
    def ball(self) -> float | None:
        """Radius [m] of the ball whose poses the loads are; None: they are pushes."""
        return float(self.provenance["ball"]) if "ball" in self.provenance else None

    @property
    def good(self) -> np.ndarray:
        """(n,) bool: the cases that converged."""
        return np.array([outcome.good for outcome in self.outcome])

    def displacement(self, nodes: np.ndarray) -> np.ndarray:
        """Displacements (n, k, 3) float32 [m] of the vertices `nodes` (k,)."""
        return self._rows("answers", nodes)

    def unit_response(self, nodes: np.ndarray) -> np.ndarray:
        """Small-strain responses (3 m, k, 3) float32 [m/N] of the vertices `nodes` (k,)."""
        return self._rows("unit", nodes)

    def _rows(self, group: str, nodes: np.ndarray) -> np.ndarray:
        with h5py.File(self.path, "r") as file:
            field = stored(file, f"{group}/displacement")
            return np.concatenate([field[row : row + CHUNK][:, nodes] for row in range(0, len(field), CHUNK)])


def read_dataset(path: str | Path) -> Dataset:
    """Read what `simulate` wrote.

    Raises
    ------
    InputError
        A file that is missing, unfinished, not HDF5, or not a data set of this project.
    """
    path = Path(path)
    if not path.is_file():
        unfinished = path.with_name(path.name + ".partial")
        remedy = (
            f"{unfinished.name} is an unfinished run: give the same `sulcus simulate` again and it goes on"
            if unfinished.exists()
            else "make one with `sulcus simulate`"
        )
        raise InputError(f"{path}: no such file; {remedy}.")
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT:
                raise InputError(f"{path}: is HDF5, but not a data set of `sulcus simulate`: make one with it.")
            anatomy = read_embedded(file)
            return Dataset(
                path,
                anatomy,
                read_loads(file),
                read_outcomes(file, "answers"),
                stored(file, "answers/iterations")[:],
                stored(file, "answers/residual")[:],
                np.array([outcome.good for outcome in read_outcomes(file, "unit")]),
                {name: str(value) for name, value in file.attrs.items()},
            )
    except (OSError, KeyError) as error:
        raise InputError(f"{path}: cannot be read as a data set ({error}). Make it with `sulcus simulate`.") from error


def write_embedded(file: h5py.File, anatomy: Anatomy) -> None:
    """Store the body itself, so that learning needs no other file."""
    for name, array in zip(MESH, anatomy.mesh.arrays, strict=False):
        file[f"anatomy/{name}"] = array
    for name in ("held", "slide_normal", "craniotomy"):
        file[f"anatomy/{name}"] = getattr(anatomy, name)
    file["anatomy"].attrs["digest"] = anatomy.digest


def read_embedded(file: h5py.File) -> Anatomy:
    """The body that a data set embeds.

    Raises
    ------
    InputError
        Arrays that do not have the digest written beside them.
    """
    array = {name: stored(file, f"anatomy/{name}")[:] for name in MESH if f"anatomy/{name}" in file}
    sets = {name: stored(file, f"anatomy/{name}")[:] for name in ("held", "slide_normal", "craniotomy")}
    anatomy = Anatomy(TetMesh(**array), **sets)
    if anatomy.digest != file["anatomy"].attrs["digest"]:
        raise InputError(f"{file.filename}: the anatomy inside was changed after it was written: simulate anew.")
    return anatomy


def write_loads(file: h5py.File, loads: Loads) -> None:
    """Store every cause's arrays under the cause's name, and the time.

    Raises
    ------
    InputError
        Causes that `read_loads` would not find again: of another kind, or several of one.
    """
    for cause in loads.causes:
        if not isinstance(cause, tuple(CAUSES.values())) or len(loads.every(type(cause))) > 1:
            names = ", ".join(type(cause).__name__ for cause in loads.causes)
            raise InputError(f"the loads have the causes {names}: a data set holds each of {', '.join(CAUSES)} once.")
        for item in fields(cause):
            file[f"loads/{type(cause).__name__}/{item.name}"] = getattr(cause, item.name)
    file["loads/time"] = loads.times


def read_loads(file: h5py.File) -> Loads:
    """The loads that `write_loads` stored."""
    causes = tuple(
        kind(**{item.name: stored(file, f"loads/{name}/{item.name}")[:] for item in fields(kind)})
        for name, kind in CAUSES.items()
        if f"loads/{name}" in file
    )
    return Loads(causes, stored(file, "loads/time")[:])


def read_outcomes(file: h5py.File, group: str) -> tuple[Outcome, ...]:
    """How the cases of `answers` or `unit` came about."""
    return tuple(Outcome[name.decode()] for name in stored(file, f"{group}/outcome")[:])


def stored(file: h5py.File, name: str) -> h5py.Dataset:
    """An array in the file.

    Raises
    ------
    KeyError
        No array has that name.
    """
    found = file[name]
    if not isinstance(found, h5py.Dataset):
        raise KeyError(f"{name} is not an array")
    return found
