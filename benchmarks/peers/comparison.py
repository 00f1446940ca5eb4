"""Comparison with other FEM packages: one mesh, the same loads from rest, one routine for all residuals.

Every engine has a separate process. Engines alternate load by load, so that other work of the machine slows all.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from sim.anatomy import Anatomy
from sim.deformation import build_start
from sim.discretisation.footprint import compute_footprint_weights
from sim.fem import Fem
from sim.loads import Loads, Nodal, Pushed
from sim.material import Material
from sim.runtime.optional_packages import install_hint
from surrogate.data.tool_loads import draw

from .child_process import HOUSE, start_program, stop_program
from .engine_process import READY, Case, to_result_path, write_case
from .engine_sulcus import build_fem

TISSUE = Material("neo-hookean", 3000.0, 0.45)
TOLERANCE = 1e-6
FINEST, LEAST = 1e-11, 1e-10
"""Tolerance of the reference, and smallest tolerance of an engine."""
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


@dataclass(frozen=True)
class Engine:
    """Engine: package, its part in use, required modules, and the arguments of `python` that start it."""

    name: str
    setting: str
    modules: tuple[str, ...]
    arguments: tuple[str, ...]
    supports_cuda: bool = False
    """True if the engine also runs on CUDA."""

    def select_device(self, device: str) -> Engine:
        """Return the engine on "cpu" or "cuda", if it supports the device."""
        if device == "cpu" or not self.supports_cuda:
            return self
        return replace(self, setting=f"{self.setting}; CUDA", arguments=(*self.arguments, device))

    @property
    def missing_reason(self) -> str:
        """Reason why the engine cannot be started here; empty if it can."""
        if any(find_spec(module) is None for module in self.modules):
            return f"not installed. {install_hint('peers')}"
        return ""

    @property
    def label(self) -> str:
        """Name and version of the engine."""
        try:
            return f"{self.name} {version(self.name)}"
        except PackageNotFoundError:
            return self.name


def _peer(name: str, setting: str, *modules: str, cards: bool = False) -> Engine:
    script = HOUSE / "benchmarks" / "peers" / f"peer_{name.replace('-', '_')}.py"
    return Engine(name, setting, modules, (str(script),), cards)


OWN = Engine(
    "sulcus", "float64; rest stiffness factorised once", (), ("-m", f"{__package__}.engine_sulcus"), supports_cuda=True
)
PEERS = (
    _peer("tled", "explicit, dynamic relaxation; float64, Warp", "warp", cards=True),
    _peer("modified-newton", "line search; PARDISO's factor at rest kept, renewed where steps are slow", "pypardiso"),
    _peer("torch-fem", "Newton, cutbacks; direct, PARDISO", "torchfem", "pypardiso"),
    _peer("scikit-fem", "Newton; basis kept, 2 threads, symmetric PARDISO", "skfem", "pypardiso"),
    _peer("felupe", "Newton, line search; threads, symmetric PARDISO", "felupe", "pypardiso"),
)


@dataclass(frozen=True)
class LoadResult:
    """Result of one load: seconds, residual (inf: none), maximum error [mm], and the reason if it failed.

    The residual is that of `Fem.residual`, the error that relative to the reference.
    """

    seconds: float
    residual: float
    apart: float
    reason: str
    tolerance: float

    @property
    def good(self) -> bool:
        """True if the residual is at most `tolerance`."""
        return self.residual <= self.tolerance


@dataclass(frozen=True)
class EngineRow:
    """Results of one engine on one mesh to one tolerance: times of first results [s] and the result of each load.

    `first_ratio` and `ratio` are times relative to sulcus; `ratio` is the median over further loads that both solved.
    """

    engine: str
    setting: str
    tolerance: float
    firsts: tuple[float, ...] = ()
    answers: tuple[LoadResult, ...] = ()
    missing: str = ""
    first_ratio: float = np.nan
    ratio: float = np.nan

    @property
    def first(self) -> float:
        """Median time [s] from a mesh to the first result; NaN if none was measured or none reached the tolerance."""
        return float(np.median(self.firsts)) if self.firsts and self.answers[0].good else np.nan

    @property
    def further(self) -> float:
        """Median time [s] of the further loads that reached the tolerance."""
        seconds = [answer.seconds for answer in self.answers[1:] if answer.good]
        return float(np.median(seconds)) if seconds else np.nan

    def add_ratios(self, reference: EngineRow) -> EngineRow:
        """Return this row with its ratios to another row."""
        pairs = zip(self.answers[1:], reference.answers[1:], strict=False)
        ratios = [mine.seconds / own.seconds for mine, own in pairs if mine.good and own.good]
        return replace(
            self, first_ratio=self.first / reference.first, ratio=float(np.median(ratios)) if ratios else np.nan
        )


@dataclass(frozen=True, eq=False)
class Reference:
    """Reference of all engines: residual of sulcus in double precision, and its solutions (L, V, 3) [m] to `FINEST`."""

    fem: Fem
    solutions: np.ndarray


def build_reference_solver(case: Case) -> Reference:
    """Build the reference of a case, for any tolerance; loads that it cannot solve to `FINEST` have NaN."""
    fem = build_fem(replace(case, tolerance=FINEST))
    found = fem.deform(Loads((Nodal(case.force),)))
    return Reference(fem, np.where((found.residual <= FINEST)[:, None, None], found.displacement, np.nan))


def build_case(anatomy: Anatomy, load_count: int, seed: int) -> Case:
    """Build a case that all engines support: sliding nodes are fixed, pushes are nodal forces.

    Raises
    ------
    InputError
        An anatomy without open cortex, or fewer loads than one.
    """
    held = np.asarray((anatomy.fixed | (anatomy.slide_normal != 0.0)).any(axis=1))
    (pushed,) = draw("palpation", anatomy, load_count, seed).get_all(Pushed)
    mesh = anatomy.mesh
    weights = compute_footprint_weights(mesh.nodes, mesh.surface, pushed.point, pushed.footprint).toarray()
    force = weights[:, :, None] * pushed.force[:, None, :]
    return Case(mesh.nodes, mesh.tets, held, TISSUE.young, TISSUE.poisson, *TISSUE.lame, force, TOLERANCE)


def compare_engines(
    case: Case, reference: Reference, engines: Sequence[Engine], start_count: int, threads: int,
    on_result: Callable[[], object],
) -> list[EngineRow]:  # fmt: skip
    """Measure a row for each engine, sulcus first; `on_result` is called after every result.

    Every engine is started once to warm up, so that it compiles its code and reads its files. It is then started
    `start_count` times (>= 0) for the first result. The last process also solves the further loads.
    """
    rows = [
        EngineRow(engine.label, engine.setting, case.tolerance, missing=engine.missing_reason) for engine in engines
    ]
    here = [number for number, row in enumerate(rows) if not row.missing]
    with TemporaryDirectory() as folder:
        places = {number: Path(folder) / str(number) for number in here}
        running: dict[int, _Process] = {}
        firsts: dict[int, list[float]] = {number: [] for number in here}
        said: dict[int, list[tuple[float, str]]] = {number: [] for number in here}
        try:
            for start in range(start_count + 1):
                for number in here:
                    if start == 0:
                        places[number].mkdir()
                        write_case(places[number], case)
                    else:
                        running.pop(number).close()
                    running[number] = _Process(engines[number], places[number], threads)
                    last = running[number].solve(0)
                    firsts[number] += [last[0]] if start else []
                    said[number] = [last]
                    on_result()
            for load in range(1, len(case.force)):
                for number in here:
                    said[number].append(running[number].solve(load))
                    on_result()
        finally:
            for process in running.values():
                process.close()
        for number in here:
            judged = _judged(reference, case, _fields(places[number], case), said[number])
            rows[number] = replace(rows[number], firsts=tuple(firsts[number]), answers=judged)
    return [row.add_ratios(rows[0]) if number else row for number, row in enumerate(rows)]


def _fields(folder: Path, case: Case) -> np.ndarray:
    """Read the displacements (L, V, 3) [m] that an engine wrote; NaN for missing ones."""
    paths = [to_result_path(folder, load) for load in range(len(case.force))]
    return np.stack([np.load(path) if path.exists() else np.full(case.nodes.shape, np.nan) for path in paths])


def _judged(
    judge: Reference, case: Case, fields: np.ndarray, said: Sequence[tuple[float, str]]
) -> tuple[LoadResult, ...]:
    """Build the result of every load, with its residual by `Fem.residual` and its error."""
    there = np.isfinite(fields).all(axis=(1, 2))
    residual, apart = np.full(len(fields), np.inf), np.full(len(fields), np.nan)
    if there.any():
        residual[there] = judge.fem.residual(Loads((Nodal(case.force[there]),)), build_start(fields[there]))
        apart[there] = 1e3 * np.linalg.norm(fields[there] - judge.solutions[there], axis=2).max(axis=1)
    return tuple(
        LoadResult(seconds, float(left), float(far), reason, case.tolerance)
        for (seconds, reason), left, far in zip(said, residual, apart, strict=True)
    )


class _Process:
    """Running process of an engine."""

    def __init__(self, engine: Engine, folder: Path, threads: int):
        self._complaints = folder / "complaints.txt"
        with open(self._complaints, "w") as complaints:
            self._child = start_program(
                [sys.executable, *engine.arguments, str(folder), str(threads)],
                dict.fromkeys(THREADS, str(threads)),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=complaints,
            )
        assert self._child.stdin is not None and self._child.stdout is not None
        self._ask, self._hear = self._child.stdin, self._child.stdout
        self._ready = self._hear.readline().strip() == READY

    def solve(self, load: int) -> tuple[float, str]:
        """Solve a load; return its time [s], and the reason of a failure or an empty string."""
        answer = ""
        if self._ready:
            try:
                print(load, file=self._ask, flush=True)
                answer = self._hear.readline()
            except BrokenPipeError:
                pass
        if not answer:
            last = self._complaints.read_text().strip().rpartition("\n")[2]
            return np.nan, f"its process ended: {last or self._child.poll()}"
        read = json.loads(answer)
        return read["seconds"], read["reason"]

    def close(self) -> None:
        """End the process."""
        stop_program(self._child)
