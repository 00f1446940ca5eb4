"""A small neural network from a load to the coefficients of a reduced basis. torch fits it, numpy runs it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Self

import numpy as np

from .protocol import standardisation


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one core: for layers this small its threads wait for each other, for minutes on a busy machine."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def forward(x: Any, weights: Sequence[Any], biases: Sequence[Any], tanh: Callable[[Any], Any]) -> Any:
    """Outputs (B, r) of the layers, of inputs x (B, f): arrays of NumPy or of torch, whose `tanh` is given."""
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        x = tanh(x @ weight + bias)
    return x @ weights[-1] + biases[-1]


@dataclass(eq=False)
class Ann:
    """Two hidden layers of tanh units, fitted by L-BFGS with weight decay.

    One network serves all vertices. A quasi-Newton method fits it on the whole set, with a fixed weight decay.

    Parameters
    ----------
    hidden
        Units in each layer.
    decay
        Weight of the summed squared weights against the summed squared error of outputs whose total variance is one.
    steps
        L-BFGS iterations.
    seed
        Of the first weights.
    """

    hidden: int = 64
    decay: float = 1e-2
    steps: int = 1000
    seed: int = 0

    def fit(self, X: np.ndarray, Y: np.ndarray) -> Self:
        """Learn from rows X (n, f), Y (n, r)."""
        import torch  # needed to fit, not to predict

        self.mean_, self.deviation_ = standardisation(X)
        self.offset_ = Y.mean(axis=0)
        # One scale for all outputs: an error in any mode counts as the displacement that it is.
        self.scale_ = np.sqrt(np.mean(np.sum((Y - self.offset_) ** 2, axis=1)) + np.finfo(float).tiny)
        inputs = torch.from_numpy((X - self.mean_) / self.deviation_)
        targets = torch.from_numpy((Y - self.offset_) / self.scale_)
        random = torch.Generator().manual_seed(self.seed)
        widths = (X.shape[1], self.hidden, self.hidden, Y.shape[1])
        weights = [
            (torch.randn(a, b, generator=random, dtype=torch.float64) / a**0.5).requires_grad_()
            for a, b in pairwise(widths)
        ]
        biases = [torch.zeros(b, dtype=torch.float64, requires_grad=True) for b in widths[1:]]

        def loss() -> torch.Tensor:
            misfit = (forward(inputs, weights, biases, torch.tanh) - targets).square().sum(dim=1).mean()
            return misfit + self.decay / len(X) * torch.stack([weight.square().sum() for weight in weights]).sum()

        search = torch.optim.LBFGS(
            [*weights, *biases],
            max_iter=self.steps,
            history_size=20,
            tolerance_change=1e-12,
            line_search_fn="strong_wolfe",
        )

        def closure() -> torch.Tensor:
            search.zero_grad()
            value = loss()
            value.backward()
            return value

        with one_thread():
            search.step(closure)
        self.weights_ = [weight.detach().numpy().astype(np.float32) for weight in weights]
        self.biases_ = [bias.detach().numpy().astype(np.float32) for bias in biases]
        return self

    def predict(self, X: np.ndarray) -> np.ndarray:
        """Coefficients (B, r) float32 of features (B, f)."""
        x = ((X - self.mean_) / self.deviation_).astype(np.float32)
        y = forward(x, self.weights_, self.biases_, np.tanh)
        return y * np.float32(self.scale_) + self.offset_.astype(np.float32)

    def state(self) -> dict[str, np.ndarray]:
        """Standardisation, and the weights and biases of each layer."""
        state = {name: np.asarray(getattr(self, f"{name}_")) for name in ("mean", "deviation", "offset", "scale")}
        state |= {f"weight{number}": weight for number, weight in enumerate(self.weights_)}
        return state | {f"bias{number}": bias for number, bias in enumerate(self.biases_)}

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray]) -> Self:
        """From `state`."""
        model = cls()
        model.mean_, model.deviation_, model.offset_ = state["mean"], state["deviation"], state["offset"]
        model.scale_ = state["scale"]
        layers = sum(name.startswith("weight") for name in state)
        model.weights_ = [state[f"weight{number}"] for number in range(layers)]
        model.biases_ = [state[f"bias{number}"] for number in range(layers)]
        return model
