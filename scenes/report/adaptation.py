"""Time that a model needs to adapt to an anatomy after resection of a fifth of its tumour."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from sim.accuracy import TRAIN
from sim.anatomy import Anatomy
from sim.effects import NodalForce, build_push_effects
from sim.fem import Fem
from sim.geometry.tetmesh import TetMesh
from surrogate.data.simulate import simulate

from .study import ReportStudy

REMOVED_SHARE = 0.2  # Removed share of the tumour's volume.


def debulk_tumour(anatomy: Anatomy) -> Anatomy:
    """Return the anatomy without the central fifth of its tumour.

    Vertices that belong to no remaining tetrahedron are removed too.
    """
    mesh = anatomy.mesh
    tumour = np.flatnonzero(anatomy.in_tumour)
    middle, volume = mesh.nodes[mesh.tets[tumour]].mean(axis=1), mesh.volumes[tumour]
    far = np.linalg.norm(middle - np.average(middle, axis=0, weights=volume), axis=1)
    inside = np.argsort(far, kind="stable")
    inside = inside[np.cumsum(volume[inside]) <= REMOVED_SHARE * volume.sum()]
    left = np.setdiff1d(np.arange(len(mesh.tets)), tumour[inside])
    used, table = np.unique(mesh.table[left], return_inverse=True)
    middles = None if mesh.middles is None else table[:, 4:]
    body = TetMesh(mesh.nodes[used], table[:, :4], mesh.region[left], middles)
    return Anatomy(body, anatomy.fixed[used], anatomy.slide_normal[used], anatomy.craniotomy[used])


def build_debulked_study(study: ReportStudy) -> ReportStudy:
    """Return the study of the debulked anatomy, whose data set `simulate_debulked` has written."""
    return replace(study, data=_to_data_path(study))


def simulate_debulked(study: ReportStudy, progress: Callable[[int], object]) -> None:
    """Solve the data set's loads on the debulked anatomy; `progress` receives the number of newly solved loads."""
    path = _to_data_path(study)
    if path.exists():
        progress(len(study.dataset.loads) + len(study.dataset.unit_good))
        return
    body, data = debulk_tumour(study.anatomy), study.dataset
    effects = (*build_push_effects(body, study.get_tissue_on(body)), NodalForce())
    fem = Fem(body, effects, TRAIN, study.device, None, study.element)
    reported = [0]

    def tell(done: int, total: int) -> None:
        progress(done - reported[0])
        reported[0] = done

    simulate(path, fem, data.loads, data.provenance, fem.batch, tell)


def read_simulation_seconds(study: ReportStudy) -> float | None:
    """Read the duration [s] of the solves of `simulate_debulked`, without set-up; None without such a data set."""
    if not _to_data_path(study).exists():
        return None
    data = build_debulked_study(study).dataset
    loads, units = len(data.loads), len(data.unit_good)
    seconds = data.estimate_seconds("load", loads), data.estimate_seconds("unit response", units)
    return None if None in seconds else sum(filter(None, seconds))


def _to_data_path(study: ReportStudy) -> Path:
    return study.folder / "answers" / f"debulked-{study.digest}.h5"
