"""Experiment of Tonutti, Gras, Yang 2017: each force position is held out once, and predicted from the others."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sim.accuracy import NO_STRAIN_LIMIT
from sim.anatomy import Anatomy
from sim.effects import Elasticity, NodalForce, build_push_effects
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads
from surrogate.data.cortex_patch import find_nearest
from surrogate.data.dataset import Dataset
from surrogate.data.indentation import get_only_pushes
from surrogate.data.simulate import simulate
from surrogate.data.solution_rows import describe_tissue_source
from surrogate.data.splits import DiscSplit
from surrogate.training.learners import LEARNED_MODELS
from surrogate.training.train import train

from ..analysis.measurement import time_work
from .finite_elements import FemVariant
from .learner import LearnerSpec
from .reference import solve_reference
from .row import ReportRow, compute_figures, summarise_times
from .rows import Spec, list_family_specs, measure_row, measure_rows
from .seed_bodies import SEED_TISSUE
from .seed_learners import PUBLISHED, fit_vertex_models, select_vertices
from .study import ReportStudy

SEED_COUNTS = (220, 22000)  # Numbers of loads of a quick and of a full run.
MAX_TRAINING = 2000  # Largest number of training loads of a model.
SCORED = 100  # Largest number of left-out loads on which `train` scores a model.
WARM_UP, TIMED = 10, 100  # Numbers of predictions of a learner before the timed ones, and of these.
PUBLISHED_LIMITS = {"published-ann": 0.3, "published-svr": 0.2}
"""Upper limits of the mean errors that the authors report for their models [mm]."""
Predict = Callable[[Loads], np.ndarray]


@dataclass(frozen=True, eq=False)
class LoadedRows(Dataset):
    """Rows of a data set in memory, with displacements (n, k, 3) [m] of ascending vertices `nodes` (k,)."""

    nodes: np.ndarray
    displacement: np.ndarray

    def read_displacement(self, nodes: np.ndarray) -> np.ndarray:
        """Return displacements (n, k, 3) [m] of `nodes` (k,), which must be in memory."""
        return self.displacement[:, np.searchsorted(self.nodes, nodes)]


@dataclass(frozen=True)
class SeedStudy(ReportStudy):
    """Study of the protocol; the reference has linear tetrahedra (p1), as in the publication."""

    reference_element: str = "p1"

    @cached_property
    def test_loads(self) -> Loads:
        """First `loads` converged loads; the loads are in random order."""
        return self.converged.select(slice(0, self.loads))

    @cached_property
    def positions(self) -> np.ndarray:
        """Distinct positions (m, 3) [m] of the forces."""
        return np.unique(self.pushed.point, axis=0)

    @cached_property
    def position(self) -> np.ndarray:
        """Index (B,) of each converged load's position in `positions`."""
        return find_nearest(self.pushed.point, self.positions)[0]

    @cached_property
    def solutions(self) -> np.ndarray:
        """Displacements (B, m, 3) [m] of the converged loads at `read_nodes`."""
        return self.dataset.read_displacement(self.read_nodes)[self.dataset.good]

    @cached_property
    def truth(self) -> np.ndarray:
        """Displacements (B, k, 3) [m] of the converged loads at `select_vertices`."""
        return self.solutions[:, np.searchsorted(self.read_nodes, select_vertices(self.anatomy))].astype(np.float64)

    def load_rows(self, rows: np.ndarray) -> LoadedRows:
        """Return a data set with the converged loads of indices `rows` (n,)."""
        data, numbers = self.dataset, np.flatnonzero(self.dataset.good)[rows]
        return LoadedRows(
            path=data.path,
            anatomy=data.anatomy,
            loads=data.loads.select(numbers),
            outcome=tuple(data.outcome[number] for number in numbers),
            iterations=data.iterations[numbers],
            residual=data.residual[numbers],
            unit_good=data.unit_good,
            provenance=data.provenance,
            nodes=self.read_nodes,
            displacement=self.solutions[rows],
        )


def simulate_seed(study: SeedStudy, body: Anatomy, loads: Loads, progress: Callable[[int, int], None]) -> None:
    """Solve the loads with p1 and the authors' tissue; write the study's data set, or resume an incomplete one."""
    tissue = Elasticity(SEED_TISSUE)
    effects = (*build_push_effects(body, tissue), NodalForce())
    fem = Fem(body, effects, NO_STRAIN_LIMIT, study.device, None, study.reference_element)
    stated = {**describe_tissue_source(tissue), "element": study.reference_element, "preset": "seed"}
    simulate(study.data, fem, loads, stated, fem.batch, progress)


def list_seed_specs() -> tuple[Spec, ...]:
    """List specifications of the published models, this project's model types, element types and model families."""
    return (
        *(LearnerSpec(name) for name in (*PUBLISHED, "linear", *LEARNED_MODELS)),
        *(FemVariant(f"FEM {element}", element=element) for element in ("p1", "smoothed", "p2")),
        *list_family_specs(),
    )


def measure_seed_rows(study: SeedStudy) -> Iterator[ReportRow]:
    """Solve the reference of the test loads, then yield all rows; stored rows are read from files."""
    solve_reference(study, lambda count: None, NO_STRAIN_LIMIT)
    return measure_rows(study, list_seed_specs(), measure_seed_row)


def measure_seed_row(study: ReportStudy, spec: Spec) -> ReportRow:
    """Measure a row of the protocol; if this is not possible, `ReportRow.state` gives the reason."""
    if not isinstance(spec, LearnerSpec):
        return measure_row(study, spec)
    assert isinstance(study, SeedStudy)
    try:
        return measure_seed_learner(study, spec)
    except InputError as error:
        return ReportRow(spec.name, "trained models", state=str(error))


def measure_seed_learner(study: SeedStudy, spec: LearnerSpec) -> ReportRow:
    """Train a model for each force position without the loads at this position, and measure it on these loads.

    Raises
    ------
    InputError
        Input that `train` rejects.
    """
    truth, fit = study.truth, _fit_published_model if spec.name in PUBLISHED else _fit_learner
    predicted, fits, count = np.empty_like(truth), [], 0
    for number in range(len(study.positions)):
        test = np.flatnonzero(study.position == number)
        training = np.flatnonzero(study.position != number)[:MAX_TRAINING]
        fits.append(time_work(fit, study, spec.name, number, training))
        predicted[test] = fits[-1][0](study.converged.select(test))
        count = max(count, len(training))
    single = np.arange(-WARM_UP, TIMED)[:, None] % len(truth)
    times = [time_work(fits[-1][0], study.converged.select(row))[1] for row in single]
    return ReportRow(
        spec.name,
        "published learners" if spec.name in PUBLISHED else "trained models",
        reference=compute_figures(predicted, truth, study.converged),
        load_mm=tuple((1e3 * np.linalg.norm(predicted - truth, axis=2).mean(axis=1)).tolist()),
        loads=count,
        solving=study.dataset.estimate_seconds("load", count),
        learning=float(np.mean([seconds for _, seconds in fits])),
        **summarise_times(times[WARM_UP:]),
    )


def _fit_published_model(study: SeedStudy, name: str, number: int, training: np.ndarray) -> Predict:
    pushed = get_only_pushes(study.converged.select(training))
    model = fit_vertex_models(name, study.anatomy, pushed, study.truth[training])
    return lambda loads: model.predict(get_only_pushes(loads))


def _fit_learner(study: SeedStudy, name: str, number: int, training: np.ndarray) -> Predict:
    tested = np.flatnonzero(study.position == number)[:SCORED]
    disc = np.repeat([-1, 0], [len(training), len(tested)])
    split = DiscSplit(study.positions[[number]], float(study.pushed.footprint[0]), disc, 0.0)
    model = train(study.load_rows(np.append(training, tested)), [name], split=split).models[name]
    nodes = select_vertices(study.anatomy)
    return lambda loads: model.deform(loads, at=nodes).displacement


def describe_seed_study(study: SeedStudy, rows: tuple[ReportRow, ...]) -> tuple[str, ...]:
    """Describe the experiment in sentences, and compare the errors of the rows with the published limits."""
    found = {row.name: row.reference for row in rows if row.reference is not None}
    verdicts = [
        f"{name} {found[name].mm.mean:.2g} mm (below {most:g} mm: {'met' if found[name].mm.mean < most else 'not met'})"
        for name, most in PUBLISHED_LIMITS.items()
        if name in found
    ]
    motion = next((f", which move the tumour by {figures.motion:.2g} mm on average" for figures in found.values()), "")
    return (
        f"Experiment of Tonutti, Gras, Yang 2017: {len(study.converged)} converged loads of "
        f"{len(study.dataset.loads)} at {len(study.positions)} positions{motion}; {len(study.anatomy.mesh.nodes)} "
        "vertices, linear tetrahedra (p1), the authors' two-term Ogden tissue.",
        "Learners: trained once for each position, on at most "
        f"{MAX_TRAINING} loads at the others, and tested on all loads there. Other models: on {len(study.test_loads)} "
        "loads. The reference is p1 as the authors had; rows of p2 and smoothed elements show how far it is from a "
        "finer discretisation.",
        f"Published mean errors, and here: {'; '.join(verdicts) or 'not measured'}.",
    )
