"""The published learners and their test: the network's evidence, the thirteen features, a position left out in turn."""

import json
from dataclasses import dataclass, field

import numpy as np
import pytest
from programs import main
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_info, threadpool_limits

from benchmarks.published import models
from benchmarks.published.bayesian import (
    Bayesian,
    descended,
    expansion,
    first_weights,
    forward,
    step,
    strengths,
    well_determined,
)
from benchmarks.published.models import (
    MACHINES,
    from_angles,
    published_model,
    published_nodes,
    sites_of,
    thirteen,
    to_angles,
)
from benchmarks.published.protocol import positions_of, trained_in_turn
from sim.deformation import Deformer, Outcome
from sim.errors import InputError
from sim.loads import Displaced, Loads, Pushed, push
from surrogate.data.simulate import simulate
from surrogate.data.tool_loads import draw

RANDOM = np.random.default_rng(11)


@pytest.fixture(scope="module")
def loads(box):
    return draw("seed", box, 240, 0)


@pytest.fixture(scope="module")
def truth(box, loads, pretender):
    return pretender.deform(loads, at=published_nodes(box)).displacement


@pytest.fixture(scope="module")
def model(box, loads, truth):
    return trained_in_turn("published-svr", box, loads, truth)


@pytest.fixture(scope="module")
def networks():
    """Two noisy functions of three features, and networks on their way to them: weights, x, y (r, n)."""
    x = RANDOM.uniform(-1.0, 1.0, (200, 3))
    y = np.stack([np.sin(2.0 * x[:, 0]) + x[:, 1], x[:, 2] ** 2]) + 0.1 * RANDOM.normal(size=(2, 200))
    weights, damping = first_weights(2, 3, 4, RANDOM), np.full(2, 1e-2)
    for _ in range(30):
        weights, _, damping = descended(weights, expansion(weights, x, y), x, y, np.ones(2), np.full(2, 50.0), damping)
    return weights, x, y


def evidence(weights, x, y, alpha, beta):
    """Logarithm of MacKay's evidence, written from its definition: the Gaussian integral round the weights."""
    terms, count = expansion(weights, x, y), weights.shape[1]
    out = []
    for k in range(len(weights)):
        hessian = beta[k] * terms.curvature[k] + alpha[k] * np.eye(count)
        energy = 0.5 * (beta[k] * terms.error[k] + alpha[k] * weights[k] @ weights[k])
        norms = 0.5 * count * np.log(alpha[k]) + 0.5 * len(x) * np.log(beta[k] / (2.0 * np.pi))
        out.append(norms - energy - 0.5 * np.linalg.slogdet(hessian)[1])
    return np.array(out)


def test_a_network_has_the_published_weights():
    assert Bayesian().fit(RANDOM.normal(size=(80, 13)), RANDOM.normal(size=(80, 2))).weights_.shape == (2, 61)


def test_expansion_is_that_of_finite_differences(networks):
    weights, x, y = networks
    steps = 1e-6 * np.eye(weights.shape[1])
    slopes = [(forward(weights + h, x)[1] - forward(weights - h, x)[1]) / 2e-6 for h in steps]
    J, error = np.stack(slopes, axis=2), forward(weights, x)[1] - y
    terms = expansion(weights, x, y)
    assert np.allclose(terms.curvature, J.transpose(0, 2, 1) @ J, rtol=1e-6, atol=1e-6)
    assert np.allclose(terms.slope, np.einsum("rnp,rn->rp", J, error), rtol=1e-6, atol=1e-6)
    assert np.allclose(terms.error, (error**2).sum(axis=1))


def test_a_step_gains_what_it_says(networks):
    _, x, y = networks
    weights, alpha, beta = first_weights(2, 3, 4, np.random.default_rng(0)), np.full(2, 0.3), np.full(2, 20.0)

    def objective(w):
        return 0.5 * (beta * np.square(forward(w, x)[1] - y).sum(axis=1) + alpha * np.square(w).sum(axis=1))

    after, gained, damping = descended(weights, expansion(weights, x, y), x, y, alpha, beta, np.array([1e-3, 1e-3]))
    assert (gained > 0.1).all() and np.allclose(objective(after), (1.0 - gained) * objective(weights))
    best = after
    for _ in range(200):
        best, gained, damping = descended(best, expansion(best, x, y), x, y, alpha, beta, damping)
    slope = beta[:, None] * expansion(best, x, y).slope + alpha[:, None] * best
    assert np.abs(slope).max() < 1e-5 and (gained < 1e-9).all()


def test_the_update_raises_the_evidence_to_its_summit(networks):
    weights, x, y = networks
    terms = expansion(weights, x, y)
    alpha, beta = np.array([30.0, 1e-3]), np.array([1.0, 1e4])
    poor = evidence(weights, x, y, alpha, beta)
    for _ in range(200):
        alpha, beta = strengths(weights, terms.error, well_determined(terms.curvature, alpha, beta), len(x))
    summit = evidence(weights, x, y, alpha, beta)
    assert (summit > poor + 10.0).all()
    for a, b in ((1.2, 1.0), (0.8, 1.0), (1.0, 1.1), (1.0, 0.9)):
        assert (evidence(weights, x, y, a * alpha, b * beta) < summit).all()


def test_the_network_tells_noise_from_signal():
    """It follows the signal through noise, and from noise alone it learns nothing: 61 free weights would miss 0.04."""
    x = RANDOM.uniform(-1.0, 1.0, (900, 13))
    clean = np.column_stack([np.tanh(2.0 * x[:, 0] - x[:, 1]) + 0.5 * x[:, 2], 0.0 * x[:, 0]])
    net = Bayesian().fit(x[:400], (clean + 0.1 * RANDOM.normal(size=clean.shape))[:400])
    miss = (net.predict(x[400:]) - clean[400:]).std(axis=0)
    assert miss[0] < 0.06 and miss[1] < 0.015


def test_features_are_those_of_the_paper(box):
    loads = draw("seed", box, 20, 3).get(Pushed)
    nodes = published_nodes(box)
    X = thirteen(*sites_of(box, nodes), loads)
    assert X.shape == (len(nodes), 20, 13)
    force, angles, distance, off, angle, axis, again = np.split(X, [3, 6, 7, 8, 9, 12], axis=2)
    way = box.mesh.nodes[nodes][:, None] - loads.point
    assert np.array_equal(force[0], loads.force) and np.array_equal(angle, again)
    assert np.allclose(np.cos(angles) * np.linalg.norm(loads.force, axis=1)[:, None], loads.force)
    assert np.allclose(distance[..., 0], np.linalg.norm(way, axis=2))
    assert np.allclose(off[0, :, 0], np.linalg.norm(loads.point - box.mesh.nodes.mean(axis=0), axis=1))
    turned = Rotation.from_rotvec((axis * angle).reshape(-1, 3)).apply(np.tile(loads.force, (len(nodes), 1)))
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    assert np.allclose(turned.reshape(way.shape), way / distance)


def test_angles_and_back():
    u = RANDOM.normal(size=(7, 5, 3))
    u[0, 0] = 0.0
    assert np.allclose(from_angles(to_angles(u)), u, atol=1e-12)
    assert np.allclose(to_angles(np.array([0.0, -2.0, 0.0])), [2.0, np.pi / 2, np.pi, np.pi / 2])


@dataclass
class Spy:
    """Remembers its rows, and predicts their number; tells how many threads its matrix products would take."""

    rows: list = field(default_factory=list)
    threads: set = field(default_factory=set)

    def fit(self, X, Y):
        self.rows = X
        self.threads = {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}
        return self

    def predict(self, X):
        return np.column_stack([np.full(len(X), len(self.rows)), np.zeros((len(X), 3))])


def test_a_position_left_out_is_never_shown(box, loads, truth, monkeypatch):
    monkeypatch.setitem(models.MACHINES, "published-svr", Spy)
    pushed, seen = loads.get(Pushed), []
    with threadpool_limits(2, "blas"):
        model = trained_in_turn("published-svr", box, loads, truth, lambda: seen.append(1))
    assert 2 <= len(model.positions) <= 11 and len(seen) == len(model.positions) * len(truth[0])
    features = thirteen(*sites_of(box, model.nodes), pushed)
    for site, part in zip(model.positions, model.models, strict=True):
        here = np.linalg.norm(pushed.point - site, axis=1) < 1e-6
        assert here.any() and not here.all()
        for node, machine in enumerate(part.machines):
            assert np.array_equal(machine.rows, features[node][~here]) and machine.threads == {1}
        # Each load is answered by the model that was trained without its position, in the order that was asked.
        first = model.deform(loads).displacement[here][:, :, 0]
        assert np.allclose(first, (~here).sum())


@pytest.mark.parametrize("name", MACHINES)
def test_it_learns_what_bodies_do(name, box, loads, truth):
    """At positions that it saw, and better than motion itself at one that it did not."""
    rows = np.arange(len(loads))
    model = published_model(name, box, loads.select(rows[::2]), truth[::2])
    miss = np.linalg.norm(model.deform(loads.select(rows[1::2])).displacement - truth[1::2], axis=2).mean()
    assert miss < {"published-ann": 0.1, "published-svr": 0.25}[name] * np.linalg.norm(truth, axis=2).mean()


def test_it_is_a_deformer(model, box, loads, truth):
    answer = model.deform(loads)
    assert isinstance(model, Deformer) and model.anatomy is box and np.array_equal(model.nodes, published_nodes(box))
    assert answer.displacement.shape == truth.shape and answer.cost.total > 0.0
    assert np.array_equal(answer.reaction[:, 0, :3], loads.get(Pushed).force)
    # Each load is answered by a model that has no training load at its position.
    assert set(answer.outcome) == {Outcome.EXTRAPOLATED}
    single = np.concatenate([model.deform(loads.select(slice(k, k + 1))).displacement for k in range(5)])
    assert np.allclose(single, answer.displacement[:5], atol=1e-8)
    some = model.nodes[[1, 0]]
    assert np.array_equal(model.deform(loads, at=some).displacement, answer.displacement[:, [1, 0]])
    assert np.linalg.norm(answer.displacement - truth, axis=2).mean() < np.linalg.norm(truth, axis=2).mean()


def test_no_force_is_answered_and_too_much_is_said(model, loads):
    assert np.isfinite(model.deform(loads.scale(0.0)).displacement).all()
    assert set(model.deform(loads.scale(20.0)).outcome) == {Outcome.EXTRAPOLATED}


def test_what_it_does_not_know_is_refused(model, box, loads, truth):
    with pytest.raises(InputError, match=r"causes Displaced"):
        model.deform(Loads((Displaced(np.zeros((1, 3)), np.full((1, 3), 1e-3), np.array([6e-3])),)))
    with pytest.raises(InputError, match=r"lacks vertex"):
        model.deform(loads, at=np.array([box.tumour_nodes[1]]))
    with pytest.raises(InputError, match=r"no published learner is called 'forest'"):
        published_model("forest", box, loads, truth)
    with pytest.raises(InputError, match=r"have 1 positions"):
        trained_in_turn("published-ann", box, push([0, 0, 0], [0, 0, -0.1], 6e-3), truth[:1])
    with pytest.raises(InputError, match=r"have 40 positions.*--preset seed"):
        trained_in_turn("published-ann", box, draw("palpation", box, 40, 0), truth[:40])


def test_underflowing_damping_keeps_matrix_regular():
    """Two slopes alike, and noise that counts as none: before, training on few loads stopped with a traceback."""
    held = 1e20 * np.ones((1, 2, 2)) + 1e-6 * np.eye(2)
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.solve(held, np.ones((1, 2, 1)))
    assert np.allclose(step(held, np.ones((1, 2))), 0.5e-20, rtol=1e-3)
    regular = np.array([[[2.0, 1.0], [1.0, 3.0]]])
    assert np.allclose(step(regular, np.array([[3.0, 4.0]])), 1.0)


def test_the_command_scores_them(pretender, loads, tmp_path, capsys):
    simulate(tmp_path / "data.h5", pretender, loads, {"preset": "seed"})
    words = ["benchmarks", "published", str(tmp_path / "data.h5"), "--learners", "published-svr", "--count", "90"]
    assert main([*words, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["loads"] == 90 and said["rows"][0]["name"] == "svr" and said["rows"][0]["seconds"] > 0.0
    assert 0.0 < said["rows"][0]["mean_mm"] < said["motion_mm"] and said["positions"] == len(positions_of(loads))
    assert main(words) == 0
    assert "each answered without its position" in capsys.readouterr().out
