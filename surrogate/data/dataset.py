"""Data sets: loads, the displacement of every vertex, and their provenance. HDF5, SI units, RAS.

Layout: `anatomy/` has the body; `loads/CAUSE/` the arrays of each cause; `answers/` and `unit/` have the arrays
`displacement` (n, V, 3) float32 [m], `outcome`, `iterations`, `residual`, `checksum`. `answers/` has a result for each
load. `unit/` has small-strain responses [m/N] to a unit force at every node `unit/node` of the open cortex, along x,
then y, then z. Data of poses have no `unit/`, but `answers/reaction` (n, tools, 6), which older files lack. Each array
has attributes that describe it (`array_meanings`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import h5py
import numpy as np

from sim.anatomy import Anatomy
from sim.deformation import Outcome
from sim.errors import InputError
from sim.geometry.tetmesh import TetMesh, compute_digest
from sim.loads import Cause, Displaced, Loads, Nodal, Posture, Prescribed, Pushed, Touching
from sim.runtime.file_limits import MAX_ARRAY_BYTES, MAX_INFLATION
from sim.runtime.outside_files import to_path, wrap_errors
from sim.runtime.partial_files import to_unfinished_path
from sim.tools import BuiltIn, read_tool_statement

from .cortex_patch import open_patch
from .solution_rows import compute_row_checksums, format_row_numbers, get_row_dtype

CAUSES: dict[str, type[Cause]] = {  # Types of loads that a data set may contain, by name.
    kind.__name__: kind for kind in (Pushed, Displaced, Nodal, Prescribed, Posture, Touching)
}
FORMAT = "sulcus data 2"  # Name and version of the file format.
OLD_FORMAT = "sulcus data 1"  # Format with flags of finished rows instead of checksums: can be read, not resumed.
MESH = ("nodes", "tets", "region", "middles")  # Names of a mesh's arrays; linear meshes have no `middles`.
CONDITIONS = ("held", "slide_normal", "craniotomy")  # Names of the boundary conditions; `held`: `Anatomy.fixed`.
SEAL_ATTRIBUTE = "digest of these attributes"  # Attribute that contains the hash of all other texts.
CHUNK_ROWS = 256  # Number of rows read at once.
MAX_DISPLACEMENT = 1.0  # Largest valid displacement [body lengths].
CHECK_FORCE = 1e-3  # Force that cannot cause a displacement of MAX_DISPLACEMENT [N], to check unit responses.
REMEDY = "Make it with `sulcus simulate`."  # Remedy in error messages.


@dataclass(frozen=True, eq=False)
class Dataset:
    """Finished data set; displacements remain in the file until they are read.

    Parameters
    ----------
    path
        HDF5 file of the data set.
    anatomy
        Anatomy of the simulation.
    loads
        Loads of n load cases.
    outcome
        Outcomes of the n cases; displacements of failed cases are not an equilibrium under the whole load.
    iterations, residual
        Solver iterations and final residual of each case (n,).
    unit_good
        Mask (3 m,) of the unit responses that converged.
    provenance
        Effects, accuracy, preset, seed, versions: as text.

    Raises
    ------
    InputError
        A column has another length than the loads, a residual of a converged case is not a finite number >= 0, or the
        tool is invalid.
    """

    path: Path
    anatomy: Anatomy
    loads: Loads
    outcome: tuple[Outcome, ...]
    iterations: np.ndarray
    residual: np.ndarray
    unit_good: np.ndarray
    provenance: Mapping[str, str]

    def __post_init__(self) -> None:
        for name in ("outcome", "iterations", "residual"):
            if len(getattr(self, name)) != len(self.loads):
                raise InputError(
                    f"{self.path}: has {len(self.loads)} loads, but `{name}` of {len(getattr(self, name))}: it is "
                    "damaged. Simulate again."
                )
        if self.residual.dtype.kind != "f" or self.iterations.dtype.kind not in "iu":
            raise InputError(f"{self.path}: its residuals or iterations are no numbers: it is damaged. Simulate again.")
        wrong = np.flatnonzero(self.good & ~((self.residual >= 0.0) & (self.residual < np.inf)))
        if len(wrong):
            raise InputError(
                f"{self.path}: {format_row_numbers(wrong)} of `answers` converged, but to a residual that is not a "
                "number: it is damaged. Simulate again."
            )
        try:
            _ = self.tool
        except InputError as error:
            raise InputError(f"{self.path}: {error} It is damaged: simulate again.") from error

    @cached_property
    def tool(self) -> BuiltIn | None:
        """Tool whose poses are the loads; None for pushes."""
        return read_tool_statement(self.provenance.get("shape"), self.provenance.get("ball"))

    @property
    def good(self) -> np.ndarray:
        """Mask (n,) of the load cases that converged."""
        return np.array([outcome.good for outcome in self.outcome], bool)

    def estimate_seconds(self, each: str, count: int) -> float | None:
        """Return the time [s] of `count` solves of a kind, "load" or "unit response"; None if not recorded."""
        try:
            found = count * float(self.provenance[f"seconds a {each}"])
        except (KeyError, ValueError):
            return None
        return found if 0.0 <= found < np.inf else None

    def read_displacement(self, nodes: np.ndarray) -> np.ndarray:
        """Read displacements (n, k, 3) float32 [m] of the vertices `nodes` (k,).

        Raises
        ------
        InputError
            Rows are damaged, or displacements are impossibly large.
        """
        return self._read_rows("answers", nodes, self.good, 1.0)

    def read_reaction(self) -> np.ndarray | None:
        """Read each tool's force on the body [N] and its moment [N m] (n, tools, 6); None if not available.

        Reactions are not available for pushes, in older files, and from deformers that do not compute them.

        Raises
        ------
        InputError
            Rows are damaged.
        """
        with wrap_errors(self.path, "a data set", REMEDY), h5py.File(self.path, "r") as file:
            if "answers/reaction" not in file:
                return None
            rows = [
                read_rows(file, "answers", len(self.anatomy.mesh.nodes), first, first + CHUNK_ROWS)
                for first in range(0, len(self.loads), CHUNK_ROWS)
            ]
        lost = np.flatnonzero(~np.concatenate([whole for _, whole in rows]))
        if len(lost):
            raise InputError(_format_damage(self.path, lost, "answers"))
        found = np.concatenate([each["reaction"] for each, _ in rows])
        return found if np.isfinite(found[self.good]).all() else None

    def compute_unit_response(self, nodes: np.ndarray) -> np.ndarray:
        """Read the small-strain responses (3 m, k, 3) float32 [m/N] of the vertices `nodes` (k,) to unit forces.

        Raises
        ------
        InputError
            See `read_displacement`.
        """
        return self._read_rows("unit", nodes, self.unit_good, CHECK_FORCE)

    def _read_rows(self, group: str, nodes: np.ndarray, is_converged: np.ndarray, force: float) -> np.ndarray:
        """Read displacements of `nodes`; check that converged rows move less than is possible under `force` [N]."""
        size = float(np.linalg.norm(np.ptp(self.anatomy.mesh.nodes, axis=0)))
        chosen, damaged, absurd = [], [], []
        with wrap_errors(self.path, "a data set", REMEDY), h5py.File(self.path, "r") as file:
            for first in range(0, max(len(is_converged), 1), CHUNK_ROWS):
                rows, whole = read_rows(file, group, len(self.anatomy.mesh.nodes), first, first + CHUNK_ROWS)
                field = rows["displacement"]
                far = np.abs(field).max(axis=(1, 2)) > MAX_DISPLACEMENT * size / force
                damaged.append(first + np.flatnonzero(~whole | ~np.isfinite(field).all(axis=(1, 2))))
                absurd.append(first + np.flatnonzero(far & is_converged[first : first + CHUNK_ROWS]))
                chosen.append(field[:, nodes])
        lost, strange = np.concatenate(damaged), np.concatenate(absurd)
        if len(lost):
            raise InputError(_format_damage(self.path, lost, group))
        if len(strange):
            raise InputError(
                f"{self.path}: {format_row_numbers(strange)} of `{group}` move by more than the body measures, "
                f"{size:.3g} m"
                f"{'' if force == 1.0 else f', under {force:g} N'}: no solver made them. Simulate again."
            )
        return np.concatenate(chosen)

    # Former names, for one release.
    seconds, displacement, reaction = estimate_seconds, read_displacement, read_reaction


def _format_damage(path: Path, damaged_rows: np.ndarray, group: str) -> str:
    return (
        f"{path}: {format_row_numbers(damaged_rows)} of `{group}` are damaged. Give its `sulcus simulate` again: "
        "it solves those alone; simulate data of an earlier version again."
    )


def read_dataset(path: str | Path) -> Dataset:
    """Read a finished data set that `simulate` wrote.

    Raises
    ------
    InputError
        The file is missing, unfinished, damaged, not HDF5, or not a data set of this project.
    """
    path = to_path(path)
    if not path.is_file():
        unfinished = to_unfinished_path(path)
        remedy = (
            f"{unfinished.name} is an unfinished run: give the same `sulcus simulate` again to resume it"
            if unfinished.exists()
            else "make one with `sulcus simulate`"
        )
        raise InputError(f"{path}: no such file; {remedy}.")
    with wrap_errors(path, "a data set", REMEDY), h5py.File(path, "r") as file:
        stated = read_provenance(file)
        if stated.get("format") not in (FORMAT, OLD_FORMAT):
            raise InputError(
                f"{path}: is HDF5, but not a data set that this version knows, {FORMAT!r}: make one with "
                "`sulcus simulate`."
            )
        anatomy, loads = read_embedded_anatomy(file), read_loads(file)
        nodes = open_patch(anatomy).nodes if loads.get(Touching) is None else np.zeros(0, int)
        if not np.array_equal(read_array(file, "unit/node", "iu", (3 * len(nodes),))[:], np.repeat(nodes, 3)):
            raise InputError(f"{path}: `unit/node` are not the open cortex's nodes: it is damaged. Simulate again.")
        for group, rows in (("answers", len(loads)), ("unit", 3 * len(nodes))):
            read_array(file, f"{group}/displacement", "f", (rows, len(anatomy.mesh.nodes), 3))
            if stated["format"] == OLD_FORMAT and not read_array(file, f"{group}/done", "b", (rows,))[:].all():
                raise InputError(f"{path}: rows of `{group}` are not done, so it was never finished. Simulate again.")
        return Dataset(
            path,
            anatomy,
            loads,
            read_outcomes(file, "answers"),
            read_array(file, "answers/iterations", "iu", (len(loads),))[:],
            read_array(file, "answers/residual", "f", (len(loads),))[:],
            np.array([outcome.good for outcome in read_outcomes(file, "unit")], bool),
            stated,
        )


def read_provenance(file: h5py.File) -> dict[str, str]:
    """Read the provenance texts of a file, and check their digest.

    Raises
    ------
    InputError
        The texts do not match the stored digest.
    """
    stated = {name: str(value) for name, value in file.attrs.items()}
    if stated.get("format") == FORMAT and stated.pop(SEAL_ATTRIBUTE, None) != compute_texts_digest(stated):
        raise InputError(f"{file.filename}: what it states of itself was changed after it was written: simulate again.")
    return stated


def write_provenance(file: h5py.File, provenance: Mapping[str, str]) -> None:
    """Store provenance texts as attributes of a file, with their digest."""
    file.attrs.update({**provenance, SEAL_ATTRIBUTE: compute_texts_digest(provenance)})


def compute_texts_digest(texts: Mapping[str, str]) -> str:
    """Compute the digest of texts and of their names."""
    return compute_digest(np.frombuffer(repr(sorted(texts.items())).encode(), np.uint8))


def read_rows(file: h5py.File, group: str, vertex_count: int, first: int, last: int) -> tuple[np.ndarray, np.ndarray]:
    """Read rows `first` to `last` of `answers` or `unit` (`get_row_dtype`), and the mask (B,) of valid checksums."""
    here = slice(first, last)
    displacement = read_array(file, f"{group}/displacement", "f", (None, vertex_count, 3))
    known = f"{group}/reaction" in file
    tools = read_array(file, f"{group}/reaction", "f", (len(displacement), None, 6)).shape[1] if known else 0
    rows = np.empty(len(range(*here.indices(len(displacement)))), get_row_dtype(vertex_count, tools))
    rows["displacement"] = displacement[here]
    for name, kinds in (("outcome", "S"), ("iterations", "iu"), ("residual", "f")):
        rows[name] = read_array(file, f"{group}/{name}", kinds, (len(displacement),))[here]
    if tools:
        rows["reaction"] = read_array(file, f"{group}/reaction", "f")[here]
    if file.attrs["format"] == OLD_FORMAT:
        return rows, np.ones(len(rows), bool)
    return rows, compute_row_checksums(rows) == read_array(file, f"{group}/checksum", "u", (len(displacement),))[here]


def write_embedded_anatomy(file: h5py.File, anatomy: Anatomy) -> None:
    """Store the anatomy in a data set, so that training needs no other file."""
    group = file.create_group("anatomy")  # groups that HDF5 creates implicitly have a date
    for name, array in zip(MESH, anatomy.mesh.arrays, strict=False):
        group[name] = array
    for name, array in zip(CONDITIONS, (anatomy.fixed, anatomy.slide_normal, anatomy.craniotomy), strict=True):
        group[name] = array
    group.attrs["digest"] = anatomy.digest


def read_embedded_anatomy(file: h5py.File) -> Anatomy:
    """Read the anatomy that a data set embeds.

    Raises
    ------
    InputError
        The arrays do not match the stored digest.
    """
    array = {name: read_array(file, f"anatomy/{name}", "fiu")[:] for name in MESH if f"anatomy/{name}" in file}
    anatomy = Anatomy(TetMesh(**array), *(read_array(file, f"anatomy/{name}", "fb")[:] for name in CONDITIONS))
    if anatomy.digest != file["anatomy"].attrs["digest"]:
        raise InputError(f"{file.filename}: the anatomy inside was changed after it was written: simulate again.")
    return anatomy


def write_loads(file: h5py.File, loads: Loads) -> None:
    """Store the arrays of every cause in a group with the cause's name, and the times.

    Raises
    ------
    InputError
        `read_loads` could not read the causes: a cause of another kind, or two of one kind.
    """
    group = file.create_group("loads")
    for cause in loads.causes:
        if not isinstance(cause, tuple(CAUSES.values())) or len(loads.get_all(type(cause))) > 1:
            names = ", ".join(type(cause).__name__ for cause in loads.causes)
            raise InputError(f"the loads have the causes {names}: a data set holds each of {', '.join(CAUSES)} once.")
        arrays = group.create_group(type(cause).__name__)
        for item in fields(cause):
            arrays[item.name] = getattr(cause, item.name)
    group["time"] = loads.times
    group.attrs["digest"] = compute_loads_digest(loads)


def read_loads(file: h5py.File) -> Loads:
    """Read the loads that `write_loads` stored.

    Raises
    ------
    InputError
        The loads do not match the stored digest.
    """
    causes = tuple(
        kind(**{item.name: read_array(file, f"loads/{name}/{item.name}", "f")[:] for item in fields(kind)})
        for name, kind in CAUSES.items()
        if f"loads/{name}" in file
    )
    loads = Loads(causes, read_array(file, "loads/time", "f")[:])
    if file.attrs.get("format") != OLD_FORMAT and file["loads"].attrs["digest"] != compute_loads_digest(loads):
        raise InputError(f"{file.filename}: the loads inside were changed after they were written: simulate again.")
    return loads


def compute_loads_digest(loads: Loads) -> str:
    """Compute the digest of the arrays of all causes and of the times."""
    names = ",".join(sorted(type(cause).__name__ for cause in loads.causes)).encode()
    ordered = sorted(loads.causes, key=lambda cause: type(cause).__name__)
    arrays = [getattr(cause, item.name) for cause in ordered for item in fields(cause)]
    return compute_digest(np.frombuffer(names, np.uint8), *arrays, loads.times)


def read_outcomes(file: h5py.File, group: str) -> tuple[Outcome, ...]:
    """Read the solver outcome of each row of `answers` or `unit`."""
    return tuple(Outcome[name.decode()] for name in read_array(file, f"{group}/outcome", "S")[:])


def read_array(
    file: h5py.File, name: str, dtype_kinds: str, shape: tuple[int | None, ...] | None = None,
    max_bytes: int = MAX_ARRAY_BYTES,
) -> h5py.Dataset:  # fmt: skip
    """Return an array in the file, with a NumPy kind in `dtype_kinds` and, if given, a `shape` (None: any length).

    Without `shape`, the array's length is known from the file only, so its size is limited to `max_bytes`.

    Raises
    ------
    InputError
        There is no such array in the file, it has another kind or shape, or it is larger than the file can contain.
    """
    found = file.get(name)
    if (
        not isinstance(found, h5py.Dataset)
        or found.file.filename != file.filename  # link to another file
        or found.is_virtual
        or found.external
    ):
        raise InputError(f"{file.filename}: has no array `{name}`. {REMEDY}")
    if found.dtype.kind not in dtype_kinds:
        raise InputError(f"{file.filename}: `{name}` holds {found.dtype}, which it cannot: it is damaged. {REMEDY}")
    expected = found.shape if shape is None else shape
    if len(expected) != len(found.shape) or any(
        a is not None and a != b for a, b in zip(expected, found.shape, strict=True)
    ):
        want = " x ".join("n" if length is None else str(length) for length in expected)
        measured = " x ".join(map(str, found.shape))
        raise InputError(f"{file.filename}: `{name}` measures {measured}, not {want}: it is damaged. {REMEDY}")
    most = MAX_INFLATION * max(Path(file.filename).stat().st_size, 4096)  # a file that is being written has no size yet
    if found.nbytes > most or (shape is None and found.nbytes > max_bytes):
        raise InputError(f"{file.filename}: `{name}` declares more than such a file holds: it is damaged. {REMEDY}")
    return found
