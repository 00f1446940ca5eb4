"""Regressors of published models: principal components, support vectors and a small neural network.

They are fitted with torch and scikit-learn, and predict with NumPy alone.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Self

import numpy as np

from ..array_functions import compute_squared_distances
from .protocol import StoredRegressor, compute_standardisation

RANK_TOLERANCE = 1e-9  # Smallest singular value relative to the largest; smaller values are round-off.


@dataclass(eq=False)
class Pcr(StoredRegressor):
    """Least-squares regression on the principal components of the features, with intercept.

    Jolliffe 2002, "Principal Component Analysis", chapter 8. The features are not scaled, so they must have one unit
    (forces at the nodes). Components are used until they explain `variance_share` of the variance: further ones would
    be fitted to positions that few loads touch.

    Parameters
    ----------
    variance_share
        Share of the variance that the components explain, in (0, 1].
    """

    kept = ("mean", "map", "offset")
    """Mean of the features (f,), linear map (f, r), offset (r,)."""
    variance_share: float = 0.999

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Self:
        """Fit to features X (n, f) and coefficients Y (n, r); return the regressor itself."""
        self.mean_, self.offset_ = X.mean(axis=0), Y.mean(axis=0)
        components, size, axes = np.linalg.svd(X - self.mean_, full_matrices=False)
        kept = 1 + int(np.searchsorted(np.cumsum(size**2), self.variance_share * np.sum(size**2)))
        kept = min(kept, int(np.sum(size > RANK_TOLERANCE * size[0])))
        # Components are orthogonal, so that each is a separate least-squares problem.
        slopes = components[:, :kept].T @ (Y - self.offset_) / size[:kept, None]
        self.map_ = axes[:kept].T @ slopes
        return self

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Predict coefficients (B, r) float32 from features (B, f)."""
        return ((X - self.mean_) @ self.map_ + self.offset_).astype(np.float32)


@dataclass(eq=False)
class Svr(StoredRegressor):
    """Support vector regression with a Gaussian kernel exp(-gamma |x - x'|^2), gamma = 1 / f, of standardised features.

    By default C = iqr(y) / 1.349 and epsilon = iqr(y) / 13.49 per output. These are MATLAB's defaults, which Tonutti,
    Gras, Yang 2017 used (Artif. Intell. Med. 80:39-47). They trained one machine per tumour node and component, which
    takes hours; one machine per mode takes seconds.

    Parameters
    ----------
    penalty, epsilon
        C and epsilon, in interquartile ranges of each output.
    """

    kept = ("mean", "deviation", "support", "dual", "intercept")
    """Standardisation, support vectors (s, f), dual coefficients (s, r), intercepts (r,)."""
    penalty: float = 1.0 / 1.349
    epsilon: float = 1.0 / 13.49

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Self:
        """Fit to features X (n, f) and coefficients Y (n, r); return the regressor itself."""
        from sklearn.svm import SVR  # needed to fit, not to predict

        self.mean_, self.deviation_ = compute_standardisation(X)
        scaled = (X - self.mean_) / self.deviation_
        spread = np.subtract(*np.percentile(Y, [75, 25], axis=0))
        dual = np.zeros((len(X), Y.shape[1]))
        intercept = np.zeros(Y.shape[1])

        def fit_output(column: int) -> SVR:
            # Outputs are divided by their interquartile range, as libsvm's stopping tolerance is absolute.
            return SVR(C=self.penalty, epsilon=self.epsilon, gamma=1.0 / X.shape[1]).fit(
                scaled, Y[:, column] / spread[column]
            )

        modes = np.flatnonzero(spread > 0.0)
        with ThreadPoolExecutor() as pool:
            machines = list(pool.map(fit_output, modes))
        for mode, machine in zip(modes, machines, strict=True):
            dual[machine.support_, mode] = spread[mode] * machine.dual_coef_[0]
            intercept[mode] = spread[mode] * machine.intercept_[0]
        intercept[spread <= 0.0] = np.median(Y[:, spread <= 0.0], axis=0)
        used = np.flatnonzero(dual.any(axis=1))
        self.support_ = scaled[used].astype(np.float32)
        self.dual_ = dual[used].astype(np.float32)
        self.intercept_ = intercept.astype(np.float32)
        return self

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Predict coefficients (B, r) float32 from features (B, f)."""
        squared = compute_squared_distances((X - self.mean_) / self.deviation_, self.support_)
        return (np.exp(squared / -len(self.mean_)) @ self.dual_ + self.intercept_).astype(np.float32)


@contextmanager
def limit_to_one_thread() -> Iterator[None]:
    """Limit torch to one thread in this context: with such small layers more threads mostly wait, for minutes."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def compute_outputs(x: Any, weights: Sequence[Any], biases: Sequence[Any], tanh: Callable[[Any], Any]) -> Any:
    """Compute a network's outputs (B, r) from inputs x (B, f), arrays of NumPy or torch with their `tanh`."""
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        x = tanh(x @ weight + bias)
    return x @ weights[-1] + biases[-1]


@dataclass(eq=False)
class Ann:
    """Neural network with two hidden layers of tanh units, fitted by L-BFGS with weight decay.

    One network predicts all vertices. It is fitted to all rows at once, with a fixed weight decay.

    Parameters
    ----------
    hidden_units
        Number of units in each hidden layer.
    weight_decay
        Weight of the sum of squared weights relative to the summed squared error of outputs scaled to total variance 1.
    max_iterations
        Maximum number of L-BFGS iterations.
    seed
        Seed of the initial weights.
    """

    hidden_units: int = 64
    weight_decay: float = 1e-2
    max_iterations: int = 1000
    seed: int = 0

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Self:
        """Fit to features X (n, f) and coefficients Y (n, r); return the regressor itself."""
        import torch  # needed to fit, not to predict

        self.mean_, self.deviation_ = compute_standardisation(X)
        self.offset_ = Y.mean(axis=0)
        # All outputs have one scale, so that errors of all modes are weighted by their displacement.
        self.scale_ = np.sqrt(np.mean(np.sum((Y - self.offset_) ** 2, axis=1)) + np.finfo(float).tiny)
        inputs = torch.from_numpy((X - self.mean_) / self.deviation_)
        targets = torch.from_numpy((Y - self.offset_) / self.scale_)
        random = torch.Generator().manual_seed(self.seed)
        widths = (X.shape[1], self.hidden_units, self.hidden_units, Y.shape[1])
        weights = [
            (torch.randn(a, b, generator=random, dtype=torch.float64) / a**0.5).requires_grad_()
            for a, b in pairwise(widths)
        ]
        biases = [torch.zeros(b, dtype=torch.float64, requires_grad=True) for b in widths[1:]]

        def compute_loss() -> torch.Tensor:
            misfit = (compute_outputs(inputs, weights, biases, torch.tanh) - targets).square().sum(dim=1).mean()
            return (
                misfit + self.weight_decay / len(X) * torch.stack([weight.square().sum() for weight in weights]).sum()
            )

        search = torch.optim.LBFGS(
            [*weights, *biases],
            max_iter=self.max_iterations,
            history_size=20,
            tolerance_change=1e-12,
            line_search_fn="strong_wolfe",
        )

        def closure() -> torch.Tensor:
            search.zero_grad()
            value = compute_loss()
            value.backward()
            return value

        with limit_to_one_thread():
            search.step(closure)
        self.weights_ = [weight.detach().numpy().astype(np.float32) for weight in weights]
        self.biases_ = [bias.detach().numpy().astype(np.float32) for bias in biases]
        return self

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Predict coefficients (B, r) float32 from features (B, f)."""
        x = ((X - self.mean_) / self.deviation_).astype(np.float32)
        y = compute_outputs(x, self.weights_, self.biases_, np.tanh)
        return y * np.float32(self.scale_) + self.offset_.astype(np.float32)

    def state(self) -> dict[str, np.ndarray]:
        """Return the standardisation, and the weights and biases of each layer, by name."""
        state = {name: np.asarray(getattr(self, f"{name}_")) for name in ("mean", "deviation", "offset", "scale")}
        state |= {f"weight{number}": weight for number, weight in enumerate(self.weights_)}
        return state | {f"bias{number}": bias for number, bias in enumerate(self.biases_)}

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray]) -> Self:
        """Rebuild the regressor from the arrays of `state`."""
        model = cls()
        model.mean_, model.deviation_, model.offset_ = state["mean"], state["deviation"], state["offset"]
        model.scale_ = state["scale"]
        layers = sum(name.startswith("weight") for name in state)
        model.weights_ = [state[f"weight{number}"] for number in range(layers)]
        model.biases_ = [state[f"bias{number}"] for number in range(layers)]
        return model
