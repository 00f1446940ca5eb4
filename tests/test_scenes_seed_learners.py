"""Learners of the seed's protocol: the thirteen features, angles, and a regressor for each vertex."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scenes.report.seed_learners import (
    PUBLISHED,
    compute_features,
    convert_from_angles,
    convert_to_angles,
    fit_vertex_models,
    select_vertices,
)
from sim.loads import Pushed
from surrogate.data.tool_loads import draw


def test_features_are_those_of_the_paper(box):
    pushed = draw("seed", box, 20, 3).get(Pushed)
    sites = box.mesh.nodes[select_vertices(box)]
    centroid = box.mesh.nodes.mean(axis=0)
    X = compute_features(sites, centroid, pushed)
    assert X.shape == (len(sites), 20, 13)
    force, angles, distance, off, angle, axis, again = np.split(X, [3, 6, 7, 8, 9, 12], axis=2)
    line = sites[:, None] - pushed.point
    assert np.array_equal(force[0], pushed.force) and np.array_equal(angle, again)
    assert np.allclose(np.cos(angles) * np.linalg.norm(pushed.force, axis=1)[:, None], pushed.force)
    assert np.allclose(distance[..., 0], np.linalg.norm(line, axis=2))
    assert np.allclose(off[0, :, 0], np.linalg.norm(pushed.point - centroid, axis=1))
    turned = Rotation.from_rotvec((axis * angle).reshape(-1, 3)).apply(np.tile(pushed.force, (len(sites), 1)))
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    assert np.allclose(turned.reshape(line.shape), line / distance)


def test_angles_and_back():
    u = np.random.default_rng(11).normal(size=(7, 5, 3))
    u[0, 0] = 0.0
    assert np.allclose(convert_from_angles(convert_to_angles(u)), u, atol=1e-12)
    assert np.allclose(convert_to_angles(np.array([0.0, -2.0, 0.0])), [2.0, np.pi / 2, np.pi, np.pi / 2])


@pytest.mark.parametrize("name", PUBLISHED)
def test_models_learn_displacements(name, box, pretender):
    loads, rows = draw("seed", box, 240, 0), np.arange(240)
    truth = pretender.deform(loads, at=select_vertices(box)).displacement
    pushed = loads.select(rows[::2]).get(Pushed)
    model = fit_vertex_models(name, box, pushed, truth[::2])
    found = model.predict(loads.select(rows[1::2]).get(Pushed))
    miss = np.linalg.norm(found - truth[1::2], axis=2).mean()
    assert miss < {"published-ann": 0.1, "published-svr": 0.25}[name] * np.linalg.norm(truth, axis=2).mean()
