"""Models of the published experiment: a regressor from 13 features for every tenth vertex of the tumour.

Tonutti, Gras, Yang 2017, "A machine learning approach for real-time modelling of tissue deformation in image-guided
neurosurgery", Artif. Intell. Med. 80:39-47. Substitutes: `BayesianNetwork` for MATLAB's `trainbr`; `Svr` for its
`fitrsvm`. The latter's automatic kernel scale is a heuristic on a random subsample; here it is the square root of the
number of features, 3.6. The mean error depends little on it: 0.37, 0.36, 0.40 and 0.53 mm at scales of 7.2, 5.1, 3.6
and 2.5. The distance to the brain's centroid, the mean of its vertices, is the loaded point's, as a vertex's own never
varies.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from sim.anatomy import Anatomy
from sim.loads import Pushed
from sim.runtime.threads import limit_to_one_thread
from surrogate.data.encode import split_forces
from surrogate.regressors.baselines import Svr

from .seed_network import BayesianNetwork

VertexRegressor = BayesianNetwork | Svr
PUBLISHED: dict[str, Callable[[], VertexRegressor]] = {"published-ann": BayesianNetwork, "published-svr": Svr}
"""Functions that build the published regressors, by name."""
VERTEX_STRIDE = 10  # One of this many tumour vertices has a model, as in the authors' animation: all take hours.


@dataclass(frozen=True, eq=False)
class VertexModels:
    """Regressors for k tumour vertices, from features of a load to magnitude and direction angles of displacement.

    Parameters
    ----------
    sites
        Undeformed positions (k, 3) [m] of the vertices.
    centroid
        Mean (3,) [m] of all mesh vertices.
    regressors
        Regressor of each vertex.
    """

    sites: np.ndarray
    centroid: np.ndarray
    regressors: tuple[VertexRegressor, ...]

    def predict(self, pushes: Pushed) -> np.ndarray:
        """Predict the displacements (B, k, 3) [m] of the vertices under B pushes."""
        features = compute_features(self.sites, self.centroid, pushes)
        angular = [one.predict(X) for one, X in zip(self.regressors, features, strict=True)]
        return convert_from_angles(np.stack(angular, axis=1).astype(np.float64))


def select_vertices(anatomy: Anatomy) -> np.ndarray:
    """Return every tenth vertex (k,) of the tumour, as mesh vertex numbers."""
    return anatomy.tumour_nodes[::VERTEX_STRIDE]


def compute_features(sites: np.ndarray, centroid: np.ndarray, pushes: Pushed) -> np.ndarray:
    """Compute the published features (k, B, 13) of B pushes for vertices `sites` (k, 3) [m].

    Features: force (3) [N], direction angles of the force (3) [rad], distances from the loaded point to the vertex and
    to `centroid` (3,) [m], angle between force and line to the vertex [rad], axis (3) and angle [rad] of this rotation.
    """
    direction = split_forces(pushes)[1]
    line = sites[:, None] - pushes.point
    distance = np.linalg.norm(line, axis=2, keepdims=True)
    line = line / np.maximum(distance, np.finfo(float).tiny)
    axis = np.cross(direction, line)
    sine = np.linalg.norm(axis, axis=2, keepdims=True)
    angle = np.arctan2(sine, np.einsum("bi,kbi->kb", direction, line)[:, :, None])
    axis = axis / np.maximum(sine, np.finfo(float).tiny)
    own = np.column_stack([pushes.force, np.arccos(np.clip(direction, -1.0, 1.0))])
    from_centroid = np.linalg.norm(pushes.point - centroid, axis=1)[:, None]
    own, from_centroid = (np.broadcast_to(part, (len(sites), *part.shape)) for part in (own, from_centroid))
    return np.concatenate([own, distance, from_centroid, angle, axis, angle], axis=2)


def convert_to_angles(displacement: np.ndarray) -> np.ndarray:
    """Convert displacements (..., 3) [m] to magnitude [m] and direction angles [rad] (..., 4)."""
    magnitude = np.linalg.norm(displacement, axis=-1, keepdims=True)
    cosine = displacement / np.maximum(magnitude, np.finfo(float).tiny)
    return np.concatenate([magnitude, np.arccos(np.clip(cosine, -1.0, 1.0))], axis=-1)


def convert_from_angles(angular: np.ndarray) -> np.ndarray:
    """Convert magnitude [m] and direction angles [rad] (..., 4) to displacements (..., 3) [m], without correction."""
    return angular[..., :1] * np.cos(angular[..., 1:])


def fit_vertex_models(name: str, anatomy: Anatomy, pushes: Pushed, displacement: np.ndarray) -> VertexModels:
    """Fit the regressor `name` of `PUBLISHED` to displacements (B, k, 3) [m] of `select_vertices` under B pushes."""
    sites, centroid = anatomy.mesh.nodes[select_vertices(anatomy)], anatomy.mesh.nodes.mean(axis=0)
    angular = convert_to_angles(np.asarray(displacement, np.float64)).transpose(1, 0, 2)

    def fit(X: np.ndarray, Y: np.ndarray) -> VertexRegressor:
        return PUBLISHED[name]().fit(X, Y)

    # Threads of BLAS would wait for each other on matrices of 61 rows, and take twelve times as long.
    with limit_to_one_thread(), ThreadPoolExecutor() as pool:
        return VertexModels(sites, centroid, tuple(pool.map(fit, compute_features(sites, centroid, pushes), angular)))
