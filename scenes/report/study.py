"""Study of a report: its test loads, inside and beyond the training range, and the recorded durations of solves."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from sim.accuracy import REFERENCE, TRAIN, Accuracy
from sim.anatomy import Anatomy
from sim.bodies.meshfile import read_anatomy
from sim.effects import Elasticity
from sim.errors import InputError
from sim.geometry.tetmesh import compute_digest
from sim.loads import Loads, Pushed
from sim.runtime.device import find_device
from sim.runtime.versions import get_version
from surrogate.data.cortex_patch import Patch, open_patch
from surrogate.data.dataset import Dataset, read_dataset
from surrogate.data.encode import split_forces
from surrogate.data.solution_rows import TISSUE_KEY, read_tissue_text
from surrogate.data.splits import DiscSplit, hold_out_discs
from surrogate.training.expansion import SERIES_MODELS, Expansion

from ..script.shipped_files import get_template_path


@dataclass(frozen=True)
class ReportStudy:
    """Data set of a report, with the numbers of compared loads and the settings of the reference.

    Parameters
    ----------
    data
        Data set of `sulcus simulate`, which defines anatomy, tissue, element and loads of the report.
    folder
        Folder in which meshes, solutions and rows are stored.
    device
        "auto", "cpu" or "cuda".
    loads, beyond, timed
        Numbers of loads: held-out loads that are compared with the reference, loads beyond the training range, and
        single loads that are timed.
    thorough
        True to halve every edge of the reference mesh, and to measure also what takes long: tools that move as in the
        reference, batches of FEM on a CPU, more FEM variants, learning curves, held-out sectors, and coverage.
    reference_element
        Element type of the reference.
    """

    data: Path
    folder: Path
    device: str = "auto"
    loads: int = 64
    beyond: int = 120
    timed: int = 1000
    thorough: bool = False
    reference_element: str = "p2"

    @cached_property
    def on_card(self) -> bool:
        """True if FEM is solved on a GPU."""
        return find_device(self.device, TRAIN.precision).on_cuda

    @property
    def reference_accuracy(self) -> Accuracy:
        """Accuracy of the reference: less in a quick report, which changes the template's tumour by 1e-5 mm."""
        return REFERENCE if self.thorough else TRAIN

    @cached_property
    def dataset(self) -> Dataset:
        """Opened data set."""
        return read_dataset(self.data)

    @cached_property
    def expansion(self) -> Expansion:
        """Power series of the FEM model, shared by all models that are trained on the data set."""
        return Expansion(self.dataset, self.device, table_path=self.folder / "answers" / f"series-{self.digest}.npz")

    @property
    def anatomy(self) -> Anatomy:
        """Anatomy of the data set."""
        return self.dataset.anatomy

    @cached_property
    def is_shipped(self) -> bool:
        """True if the anatomy is the shipped template, of which other meshes can be built."""
        return self.anatomy.digest == read_anatomy(get_template_path()).digest

    @cached_property
    def tissue(self) -> Elasticity:
        """Tissue of the data set, including the tissues of regions."""
        stated = self.dataset.provenance
        return read_tissue_text(stated) if TISSUE_KEY in stated else Elasticity()

    def get_tissue_on(self, body: Anatomy) -> Elasticity:
        """Return the tissue of the data set, restricted to the regions of the mesh of `body`."""
        return self.tissue.restrict(np.unique(body.mesh.region).tolist())

    @property
    def element(self) -> str:
        """Element type of the data set."""
        return self.dataset.provenance.get("element", "p1")

    @cached_property
    def patch(self) -> Patch:
        """Open cortex of the anatomy, on which the loads act."""
        return open_patch(self.anatomy)

    @cached_property
    def read_nodes(self) -> np.ndarray:
        """Sorted vertices (m,) of tumour and open cortex, at which solutions are compared."""
        return np.union1d(self.patch.nodes, self.anatomy.tumour_nodes)

    @cached_property
    def converged(self) -> Loads:
        """Converged loads of the data set, in the order of the rows of a split."""
        return self.dataset.loads.select(np.flatnonzero(self.dataset.good))

    @property
    def pushed(self) -> Pushed:
        """Pushes of the `converged` loads.

        Raises
        ------
        InputError
            The data set contains loads other than pushes.
        """
        pushed = self.converged.get_only(Pushed)
        if pushed is None:
            raise InputError(f"{self.data}: holds other loads than pushes: simulate pushes.")
        return pushed

    @cached_property
    def data_displacement(self) -> np.ndarray:
        """Displacements (B, k, 3) [m] of the loads `converged` at the tumour's vertices, from the data set."""
        return self.dataset.read_displacement(self.anatomy.tumour_nodes)[self.dataset.good]

    @cached_property
    def disc_split(self) -> DiscSplit:
        """Split of the converged loads by held-out discs of the cortex."""
        return hold_out_discs(self.pushed.point, self.patch)

    @cached_property
    def test_loads(self) -> Loads:
        """At most `loads` loads of the held-out discs, chosen evenly over the sorted forces."""
        rows = np.flatnonzero(self.disc_split.test_mask)
        rows = rows[np.argsort(split_forces(self.pushed)[0][rows], kind="stable")]
        chosen = np.unique(np.linspace(0, len(rows) - 1, min(self.loads, len(rows))).round().astype(int))
        return self.converged.select(rows[chosen])

    @cached_property
    def loads_beyond(self) -> Loads:
        """Loads beyond the training range: in equal parts stronger, more oblique, and nearer to the craniotomy edge."""
        pushed = self.converged.select(np.flatnonzero(self.disc_split.test_mask)).get(Pushed)
        training = self.converged.select(np.flatnonzero(self.disc_split.training_mask)).get(Pushed)
        assert pushed is not None and training is not None
        return draw_extrapolated_loads(self.patch, training, pushed, self.beyond)

    @cached_property
    def digest(self) -> str:
        """Hash of all inputs that determine the reference solutions."""
        data = self.dataset
        on = "cuda" if self.on_card else "cpu"
        stated = repr(
            (sorted(data.provenance.items()), self.loads, self.beyond, self.thorough, on, get_version("sulcus"))
        )
        return compute_digest(np.frombuffer(stated.encode(), np.uint8), data.good, *vars(self.pushed).values())


FORCE_RATIOS = (1.2, 1.6)  # Range of forces beyond the training, relative to its largest force.
EXTRA_ANGLES = (5.0, 15.0)  # Range of angles beyond the training's largest angle [deg].
EDGE_DISTANCES = (0.5, 0.9)  # Range of distances of a centre from the edge, relative to the radius.
KINDS = ("stronger", "more oblique", "nearer to the rim")  # Kinds of loads beyond the training range.


def draw_extrapolated_loads(patch: Patch, training: Pushed, pattern_pushes: Pushed, count: int) -> Loads:
    """Draw `count` loads, a third of each kind in `KINDS`, otherwise distributed as `pattern_pushes`; deterministic."""
    random = np.random.default_rng(0)
    rows = random.integers(len(pattern_pushes.point), size=count)
    kind = np.arange(count) % len(KINDS)
    size, direction = split_forces(replace(pattern_pushes, force=pattern_pushes.force[rows]))
    point, footprint = pattern_pushes.point[rows], pattern_pushes.footprint[rows]
    size = np.where(kind == 0, split_forces(training)[0].max() * random.uniform(*FORCE_RATIOS, count), size)
    oblique = _turn_from_normal(
        direction, patch.find_normals(point), _compute_max_angle(patch, training), random.uniform(*EXTRA_ANGLES, count)
    )
    direction = np.where((kind == 1)[:, None], oblique, direction)
    point = np.where((kind == 2)[:, None], _sample_near_rim(patch, footprint, random), point)
    return Loads((Pushed(point, size[:, None] * direction, footprint),))


def _compute_max_angle(patch: Patch, pushes: Pushed) -> float:
    """Compute the largest angle [rad] between a push's force and the inward normal."""
    cosine = np.einsum("bi,bi->b", split_forces(pushes)[1], patch.find_normals(pushes.point))
    return float(np.arccos(np.clip(cosine.min(), -1.0, 1.0)))


def _turn_from_normal(direction: np.ndarray, normal: np.ndarray, angle: float, more: np.ndarray) -> np.ndarray:
    """Return unit directions (B, 3): `normal` tilted to `direction` by `angle` [rad] + `more` [deg], at most 85 deg."""
    along = direction - np.einsum("bi,bi->b", direction, normal)[:, None] * normal
    length = np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(normal, np.eye(3)[np.abs(normal).argmin(axis=1)])
    along = np.where(length > 1e-9, along / np.maximum(length, 1e-9), across / np.linalg.norm(across, axis=1)[:, None])
    turn = np.minimum(angle + np.radians(more), np.radians(85.0))[:, None]
    return np.cos(turn) * normal + np.sin(turn) * along


def _sample_near_rim(patch: Patch, footprint: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Sample points (B, 3) [m] whose footprints of radii (B,) [m] extend beyond the edge by 0.1 to 0.5 radii."""
    points = patch.place_points(random.random((4096, 3)))[0]
    ratio = patch.compute_edge_distance(points)[None] / footprint[:, None]
    wanted = random.uniform(*EDGE_DISTANCES, len(footprint))[:, None]
    return points[np.abs(ratio - wanted).argmin(axis=1)]


def tabulate_series(study: ReportStudy, progress: Callable[[int, int], object]) -> None:
    """Compute the power-series table if the data set records its tissue; `progress` receives (done, total) places."""
    if "tissue" in study.dataset.provenance:
        replace(study.expansion, progress=progress).table  # noqa: B018 (asking makes it)


def measure_series_seconds(study: ReportStudy, learner: str) -> float:
    """Return the time [s] spent on the power-series table; 0 if the model type does not use the table."""
    return study.expansion.table.seconds if learner in SERIES_MODELS else 0.0
