"""The published model: a learner for each tenth vertex of the tumour.

Tonutti, Gras, Yang 2017, "A machine learning approach for real-time modelling of tissue deformation in image-guided
neurosurgery", Artif. Intell. Med. 80:39-47. Substitutes: `Bayesian` for MATLAB's `trainbr`; `Svr` for its `fitrsvm`.
The latter's automatic kernel scale is a heuristic on a random subsample. Here it is the square root of the number of
features, 3.6. The mean error depends little on it: 0.37, 0.36, 0.40 and 0.53 mm at scales of 7.2, 5.1, 3.6 and 2.5. The
distance to the brain's centroid, the mean of its vertices, is the loaded point's, as a vertex's own never varies.
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sim.anatomy import Anatomy
from sim.deformation import Deformation
from sim.errors import InputError
from sim.loads import Loads, Pushed
from sim.runtime.threads import limit_to_one_thread
from surrogate.data.cortex_patch import Patch, open_patch
from surrogate.data.encode import split_forces
from surrogate.model.learned import build_prediction, get_only_pushes
from surrogate.model.training_range import Envelope, compute_training_range
from surrogate.regressors.baselines import Svr
from surrogate.regressors.protocol import Regressor

from .bayesian import Bayesian

MACHINES: dict[str, Callable[[], Regressor]] = {"published-ann": Bayesian, "published-svr": Svr}
# As the authors' own animation did: a machine for every vertex takes hours.
EVERY = 10


@dataclass(frozen=True, eq=False)
class Published:
    """A regressor for each of some tumour vertices, as a `Deformer`: it predicts displacements, not responses to 1 N.

    Parameters
    ----------
    anatomy
        The body that it was trained on.
    nodes
        (k,) the vertices that it knows.
    machines
        k regressors from 13 features to magnitude and direction angles.
    envelope
        The range of its training loads.
    """

    anatomy: Anatomy
    nodes: np.ndarray
    machines: tuple[Regressor, ...]
    envelope: Envelope

    @cached_property
    def _patch(self) -> Patch:
        return open_patch(self.anatomy)

    @cached_property
    def _sites(self) -> tuple[np.ndarray, np.ndarray]:
        return sites_of(self.anatomy, self.nodes)

    def deform(self, loads: Loads, start: Deformation | None = None, at: np.ndarray | None = None) -> Deformation:
        """Predict the static answer to `Pushed` loads; `start` has no influence.

        Raises
        ------
        InputError
            Loads of another kind, or a vertex in `at` that the model does not know.
        """
        begun = time.perf_counter()
        pushed = get_only_pushes(loads)
        features = thirteen(*self._sites, pushed)
        angular = [machine.predict(X) for machine, X in zip(self.machines, features, strict=True)]
        displacement = from_angles(np.stack(angular, axis=1).astype(np.float64))
        outside = ~self.envelope.is_inside(self._patch, pushed)
        answer = build_prediction(
            displacement, self.nodes, loads, outside, begun, np.array(np.nan), "published protocol"
        )
        return answer if at is None else answer.restrict(np.asarray(at))


def published_nodes(anatomy: Anatomy) -> np.ndarray:
    """Every tenth vertex (k,) of the tumour."""
    return anatomy.tumour_nodes[::EVERY]


def sites_of(anatomy: Anatomy, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the vertices `nodes` (k,) lie, (k, 3) [m], and the mean of all vertices, (3,) [m]."""
    return anatomy.mesh.nodes[nodes], anatomy.mesh.nodes.mean(axis=0)


def thirteen(sites: np.ndarray, centroid: np.ndarray, pushed: Pushed) -> np.ndarray:
    """The published features of B loads as seen from `sites` (k, 3) [m]: (k, B, 13).

    Force [N] (3), its direction angles [rad] (3), and distances from point to site and to `centroid` (3,) [m]. Then the
    angle [rad] between force and the way to the site, and the axis (3) and angle [rad] of the rotation from one to the
    other.
    """
    _, direction = split_forces(pushed)
    way = sites[:, None] - pushed.point
    distance = np.linalg.norm(way, axis=2, keepdims=True)
    way = way / np.maximum(distance, np.finfo(float).tiny)
    axis = np.cross(direction, way)
    sine = np.linalg.norm(axis, axis=2, keepdims=True)
    angle = np.arctan2(sine, np.einsum("bi,kbi->kb", direction, way)[:, :, None])
    axis = axis / np.maximum(sine, np.finfo(float).tiny)
    own = np.column_stack([pushed.force, np.arccos(np.clip(direction, -1.0, 1.0))])
    off = np.linalg.norm(pushed.point - centroid, axis=1)[:, None]
    seen = [np.broadcast_to(part, (len(sites), *part.shape)) for part in (own, off)]
    return np.concatenate([seen[0], distance, seen[1], angle, axis, angle], axis=2)


def to_angles(displacement: np.ndarray) -> np.ndarray:
    """Magnitude [m] and direction angles [rad] (..., 4) of displacements (..., 3) [m]."""
    magnitude = np.linalg.norm(displacement, axis=-1, keepdims=True)
    cosine = displacement / np.maximum(magnitude, np.finfo(float).tiny)
    return np.concatenate([magnitude, np.arccos(np.clip(cosine, -1.0, 1.0))], axis=-1)


def from_angles(angular: np.ndarray) -> np.ndarray:
    """Displacements (..., 3) [m]; angles that belong to no direction are not reconciled."""
    return angular[..., :1] * np.cos(angular[..., 1:])


def published_model(
    name: str, anatomy: Anatomy, loads: Loads, truth: np.ndarray, progress: Callable[[], object] = lambda: None
) -> Published:
    """Fit a learner of `MACHINES` to displacements `truth` (B, k, 3) [m] of `published_nodes`; vertices side by side.

    Raises
    ------
    InputError
        An unknown learner, or loads of another kind than `Pushed`.
    """
    if name not in MACHINES:
        raise InputError(f"no published learner is called {name!r}: choose from {', '.join(MACHINES)}.")
    pushed, nodes = get_only_pushes(loads), published_nodes(anatomy)
    angular = to_angles(np.asarray(truth, np.float64))

    def update_history(X: np.ndarray, Y: np.ndarray) -> Regressor:
        machine = MACHINES[name]().fit(X, Y)
        progress()
        return machine

    envelope = compute_training_range(open_patch(anatomy), pushed)
    # Matrices of 61 rows are no work for several cores: their threads would wait for each other, twelve times as long.
    with limit_to_one_thread(), ThreadPoolExecutor() as pool:
        machines = pool.map(update_history, thirteen(*sites_of(anatomy, nodes), pushed), angular.transpose(1, 0, 2))
        return Published(anatomy, nodes, tuple(machines), envelope)
