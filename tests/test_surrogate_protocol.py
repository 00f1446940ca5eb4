"""Common tests of every regressor."""

import subprocess
import sys

import numpy as np
import pytest

from surrogate.model.store import REGRESSORS
from surrogate.regressors.baselines import Ann, Pcr, Svr
from surrogate.regressors.gp import Gp
from surrogate.regressors.protocol import Linear

MAKE = {"linear": Linear, "ann": lambda: Ann(hidden_units=12, max_iterations=150), "svr": Svr, "gp": Gp}
MAKE["pcr"] = lambda: Pcr(variance_share=1.0)  # its features here have several units
LEARNT = {"linear": 0.25, "pcr": 0.25, "ann": 0.05, "svr": 0.25, "gp": 0.01}
"""Error in the largest output against its deviation."""
RANDOM = np.random.default_rng(3)
MIX, BEND = RANDOM.normal(size=(5, 4)), RANDOM.normal(size=(5, 4))


def rows(count, seed):
    """Features with a constant column, and outputs of very different size, nearly linear in them."""
    X = np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 5)) * [1.0, 1e-3, 10.0, 1.0, 0.0] + [0, 0, 0, 0, 1.0]
    unit = X * [1.0, 1e3, 0.1, 1.0, 1.0]
    return X, (unit @ MIX + 0.2 * np.sin(2.0 * unit) @ BEND) * [1e-2, 1e-3, 1e-4, 1e-3]


@pytest.fixture(scope="module", params=REGRESSORS)
def fitted(request):
    return request.param, MAKE[request.param]().fit(*rows(300, 0))


def test_protocol_tests_cover_every_regressor():
    assert set(MAKE) == set(REGRESSORS)


def test_fit_returns_self_and_predict_has_output_shape(fitted):
    name, model = fitted
    X, Y = rows(50, 1)
    fresh = MAKE[name]()
    assert fresh.fit(*rows(60, 0)) is fresh
    assert model.predict(X).shape == Y.shape and model.predict(X).dtype == np.float32


def test_repeated_fit_gives_equal_predictions(fitted):
    name, model = fitted
    X, _ = rows(50, 1)
    assert np.array_equal(MAKE[name]().fit(*rows(300, 0)).predict(X), model.predict(X))


def test_restored_state_predicts_identically(fitted, tmp_path):
    name, model = fitted
    X, _ = rows(50, 1)
    np.savez(tmp_path / "state.npz", **model.state())
    with np.load(tmp_path / "state.npz", allow_pickle=False) as state:
        again = REGRESSORS[name].restored(dict(state))
    assert np.array_equal(again.predict(X), model.predict(X))


def test_regressor_error_is_below_its_limit(fitted):
    """Far better than the mean in the largest output, and better in every output."""
    name, model = fitted
    X, Y = rows(400, 2)
    miss = np.sqrt(np.mean((model.predict(X) - Y) ** 2, axis=0)) / Y.std(axis=0)
    assert (miss < 0.9).all() and miss[0] < LEARNT[name]


def test_batch_prediction_equals_row_predictions(fitted):
    _, model = fitted
    X, _ = rows(20, 4)
    single = np.concatenate([model.predict(row[None]) for row in X])
    assert np.allclose(model.predict(X), single, rtol=1e-5, atol=1e-8)


def test_predictions_are_continuous_in_the_features(fitted):
    """A relative step of 1e-6 in the features changes no output by more than 0.1 % of its deviation."""
    _, model = fitted
    X, Y = rows(20, 5)
    nudged = model.predict(X * (1.0 + 1e-6))
    assert (np.abs(nudged - model.predict(X)) < 1e-3 * Y.std(axis=0)).all()


def test_linear_table_is_exact_from_unit_rows():
    C = RANDOM.normal(size=(9, 3))
    X = RANDOM.normal(size=(4, 9))
    assert np.allclose(Linear().fit(np.eye(9), C).predict(X), X @ C, atol=1e-5)


def test_prediction_imports_neither_torch_nor_sklearn():
    script = (
        "import sys, numpy as np, surrogate.model.store\n"
        "from surrogate.regressors.protocol import Linear\n"
        "Linear().fit(np.eye(2), np.eye(2)).predict(np.eye(2))\n"
        "assert not {'torch', 'sklearn', 'warp', 'meshio'} & set(sys.modules), sys.modules.keys()\n"
    )
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0
