"""Eigenvalues and eigenvectors on the device: exact to the last digits, also where eigenvalues are equal."""

import numpy as np
import pytest
import warp as wp

from sim.runtime.device import Precision, find_device
from sim.terms.laws.spectral import compute_principal_axes


def matrices() -> np.ndarray:
    """Symmetric (n, 3, 3): of every size, with eigenvalues that are apart, close, equal and zero."""
    rng = np.random.default_rng(0)
    Q, _ = np.linalg.qr(rng.normal(size=(600, 3, 3)))
    value = rng.normal(size=(600, 3))
    value[100:200, 1] = value[100:200, 0]
    value[200:300, 1] = value[200:300, 0] * (1.0 + 10.0 ** rng.uniform(-12, -2, 100))
    value[300:400] = value[300:400, :1] * (1.0 + 1e-6 * rng.normal(size=(100, 3)))
    value[400:500, 0] = 0.0
    value[500:] *= 10.0 ** rng.uniform(-12, 6, (100, 1))
    found = Q @ (value[:, :, None] * Q.transpose(0, 2, 1))
    found = (found + found.transpose(0, 2, 1)) / 2.0
    return np.concatenate([found, np.zeros((1, 3, 3)), np.eye(3)[None], np.ones((1, 3, 3)), np.diag([1.0, 2, 1])[None]])


@pytest.mark.parametrize(("precision", "digit"), [("float32", 2.0**-23), ("float64", 2.0**-52)])
def test_principal_axes_diagonalise_the_matrix(precision: Precision, digit: float) -> None:
    device = find_device("cpu", precision)
    mat, vec = device.matrix, device.vector

    @wp.kernel(module="unique")
    def decompose(
        A: wp.array(dtype=mat),
        # outputs
        value: wp.array(dtype=vec),
        axes: wp.array(dtype=mat),
    ):
        i = wp.tid()
        e, N = compute_principal_axes(A[i])
        value[i] = e
        axes[i] = N

    given = device.upload(matrices(), mat)
    count = len(given)
    value, axes = wp.zeros(count, dtype=vec, device="cpu"), wp.zeros(count, dtype=mat, device="cpu")
    device.launch(decompose, (count,), [given], [value, axes])
    A, e, N = (array.numpy().astype(np.float64) for array in (given, value, axes))
    exact = np.linalg.eigvalsh(A)
    size = np.abs(exact).max(axis=1)
    assert (np.abs(np.sort(e, axis=1) - exact).max(axis=1) <= 8.0 * digit * size).all()
    assert np.abs(N @ N.transpose(0, 2, 1) - np.eye(3)).max() <= 8.0 * digit
    restored = N.transpose(0, 2, 1) @ (e[:, :, None] * N)
    assert (np.abs(restored - A).max(axis=(1, 2)) <= 16.0 * digit * size).all()
