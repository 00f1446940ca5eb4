"""Fill a data set with a deformer's answers, batch by batch, so that a killed run goes on where it stopped."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from sim.anatomy import Anatomy
from sim.deformation import Deformation, Deformer, Outcome
from sim.errors import InputError
from sim.loads import Loads, Nodal, Touching
from sim.stages import listened, stage

from .dataset import FORMAT, read_loads, stored, write_embedded, write_loads
from .patch import open_patch

# Far inside the small-strain range: 1 uN on one node of brain tissue strains its elements by some 1e-5, so that one
# solve with the rest stiffness is the answer.
UNIT_FORCE = 1e-6
# What the groups of the file are called where their seconds are told.
STAGES = {"unit": "unit responses", "answers": "loads"}
NAME_TYPE = f"S{max(len(outcome.name) for outcome in Outcome)}"


@dataclass(frozen=True)
class Solved:
    """What one call solved anew: rows of unit responses and of loads, and the seconds that each took, with writing."""

    units: int = 0
    loads: int = 0
    unit_seconds: float = 0.0
    load_seconds: float = 0.0

    @property
    def rows(self) -> int:
        """All of them."""
        return self.units + self.loads


def simulate(
    path: str | Path,
    deformer: Deformer,
    loads: Loads,
    provenance: Mapping[str, str],
    batch: int = 64,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Solved:
    """Answer every load, and the unit forces on the open cortex unless the loads are poses, into an HDF5 file.

    Rows go to `PATH.partial`, whose whole space is laid out first: a kill at any moment leaves a file that opens, and
    the same call goes on at the first unfinished batch with the same batches, so the result has the same bytes. The
    finished file takes its name last. More loads of the same draw extend a finished file.

    Parameters
    ----------
    deformer
        Answers `loads` and `Nodal` loads at every vertex.
    provenance
        Texts that must agree for a run to go on.
    progress
        Told the rows that are done and their total after every batch.

    Raises
    ------
    InputError
        A batch below one, a file that holds something else or is being written, a folder that cannot be written to.
    """
    path = Path(path)
    if batch < 1:
        raise InputError(f"a batch of {batch} solves nothing: give --batch >= 1.")
    stated = {**provenance, "format": FORMAT, "anatomy": deformer.anatomy.digest, "batch": str(batch)}
    partial = path.with_name(path.name + ".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not partial.exists():
            with h5py.File(path, "r") as finished:
                _demand_same(finished, stated, loads)
                if len(stored(finished, "answers/done")) >= len(loads):
                    return Solved()
        if not partial.exists():
            _lay_out(partial, deformer.anatomy, loads, stated, path if path.exists() else None, batch)
        with h5py.File(partial, "r+") as file:
            _demand_same(file, stated, loads, len(loads))
            solved = _fill(file, deformer, loads, batch, progress)
        partial.replace(path)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error}). Another run may be writing it; else choose another name."
        ) from error
    return solved


def unit_loads(anatomy: Anatomy, rows: np.ndarray) -> Loads:
    """`UNIT_FORCE` at open-cortex node row // 3 along axis row % 3, for each of `rows` (B,)."""
    force = np.zeros((len(rows), len(anatomy.mesh.nodes), 3))
    force[np.arange(len(rows)), open_patch(anatomy).nodes[rows // 3], rows % 3] = UNIT_FORCE
    return Loads((Nodal(force),))


def _fill(
    file: h5py.File, deformer: Deformer, loads: Loads, batch: int, progress: Callable[[int, int], None]
) -> Solved:
    """Solve what is not done. A second thread writes each batch while the next is solved: one ahead, in order."""
    done = {name: stored(file, f"{name}/done")[:] for name in ("unit", "answers")}
    total = sum(len(flags) for flags in done.values())
    solved = dict.fromkeys(done, 0)
    with listened() as seconds, ThreadPoolExecutor(1) as writer:
        for name, flags in done.items():
            written: Future[None] | None = None
            with stage(STAGES[name]):
                for first in range(0, len(flags), batch):
                    rows = np.arange(first, min(first + batch, len(flags)))
                    if not flags[rows].all():
                        asked = unit_loads(deformer.anatomy, rows) if name == "unit" else loads.rows(rows)
                        answer = deformer.deform(asked).at(np.arange(len(deformer.anatomy.mesh.nodes)))
                        if written is not None:
                            written.result()
                        written = writer.submit(_write, file, name, first, answer)
                        solved[name] += len(rows)
                    flags[rows] = True
                    progress(sum(int(every.sum()) for every in done.values()), total)
                if written is not None:
                    written.result()
    return Solved(solved["unit"], solved["answers"], *seconds.values())


def _write(file: h5py.File, name: str, first: int, answer: Deformation) -> None:
    """Put answers into the rows from `first` on, and then call them done."""
    response = answer.displacement / UNIT_FORCE if name == "unit" else answer.displacement
    columns = {
        # In the width of the file, 64 kB a load on a brain of 5,300 nodes: HDF5 converts at a third of the speed.
        "displacement": response.astype(np.float32, copy=False),
        "outcome": np.array([outcome.name for outcome in answer.outcome], NAME_TYPE),
        "iterations": answer.iterations,
        "residual": answer.residual,
    }
    here = slice(first, first + len(answer))
    for item, column in columns.items():
        stored(file, f"{name}/{item}")[here] = column
    file.flush()  # the rows must be in the file before they are called done
    stored(file, f"{name}/done")[here] = True
    file.flush()


def _lay_out(
    partial: Path, anatomy: Anatomy, loads: Loads, stated: Mapping[str, str], finished: Path | None, batch: int
) -> None:
    """Create the file with all its space; keep the whole batches of a `finished` file that it extends."""
    nodes = open_patch(anatomy).nodes if loads.of(Touching) is None else np.zeros(0, int)
    draft = partial.with_name(f".{partial.name}")
    try:
        with h5py.File(draft, "w") as file:
            file.attrs.update(stated)
            file.attrs.update(length_unit="m", force_unit="N", frame="RAS")
            write_embedded(file, anatomy)
            write_loads(file, loads)
            for name, rows in (("unit", 3 * len(nodes)), ("answers", len(loads))):
                group = file.create_group(name)
                for item, shape, kind in (
                    ("displacement", (rows, len(anatomy.mesh.nodes), 3), np.float32),
                    ("outcome", (rows,), NAME_TYPE),
                    ("iterations", (rows,), np.int32),
                    ("residual", (rows,), np.float64),
                    ("done", (rows,), bool),
                ):
                    array = group.create_dataset(item, shape, kind)
                    if rows:  # a first write makes HDF5 allocate the whole array: later writes touch no metadata
                        array[-1] = np.zeros(shape[1:], kind)
            file["unit/node"] = np.repeat(nodes, 3)
            if finished is not None:
                with h5py.File(finished, "r") as source:
                    _copy_batches(source, file, batch)
        draft.replace(partial)
    finally:
        draft.unlink(missing_ok=True)


def _copy_batches(source: h5py.File, target: h5py.File, batch: int) -> None:
    """Whole batches only: a last short batch would have been solved in other company."""
    for name in ("unit", "answers"):
        rows = len(stored(source, f"{name}/done"))
        whole = rows if rows == len(stored(target, f"{name}/done")) else rows // batch * batch
        for item in ("displacement", "outcome", "iterations", "residual", "done"):
            for first in range(0, whole, batch):
                here = slice(first, min(first + batch, whole))
                stored(target, f"{name}/{item}")[here] = stored(source, f"{name}/{item}")[here]


def _demand_same(file: h5py.File, stated: Mapping[str, str], loads: Loads, count: int | None = None) -> None:
    """Raise unless the file was begun with the same texts and the same loads (and as many, if `count` is given)."""
    for name, wanted in stated.items():
        found = file.attrs.get(name, "nothing")
        if found != wanted:
            raise InputError(
                f"{file.filename}: was made with {name} {found}, but now {name} is {wanted}: repeat the first command, "
                "or choose another --out."
            )
    before = read_loads(file)
    if count is not None and len(before) != count:
        raise InputError(
            f"{file.filename}: was begun for {len(before)} loads, not {count}: finish it first, or delete it."
        )
    shared = np.arange(min(len(before), len(loads)))
    if not _equal(before.rows(shared), loads.rows(shared)):
        raise InputError(f"{file.filename}: holds other loads than these: choose another --out.")


def _equal(one: Loads, other: Loads) -> bool:
    """Whether two sets of loads are the same, bit by bit."""
    kinds = [sorted(type(cause).__name__ for cause in loads.causes) for loads in (one, other)]
    pairs = [(a, b) for a in one.causes for b in other.causes if type(a) is type(b)]
    return kinds[0] == kinds[1] and all(
        np.array_equal(array, vars(b)[name]) for a, b in pairs for name, array in vars(a).items()
    )
