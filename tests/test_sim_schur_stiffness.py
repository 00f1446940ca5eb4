"""Condensed surroundings as an energy term."""

import numpy as np
import warp as wp

from sim.runtime.device import find_device
from sim.terms.schur_stiffness import Exterior


def test_exterior_gradient_is_derivative_of_its_energy() -> None:
    device, random = find_device("cpu", "float64"), np.random.default_rng(0)
    root, rows = random.normal(size=(4, 4)), np.array([1, 2, 5, 7])
    exterior = Exterior(rows, root @ root.T, 9, device)
    u, d = random.normal(size=(2, 9, 3))
    out, energy = device.allocate(9, 3), [wp.zeros(3, dtype=wp.float64, device=device.name) for _ in range(2)]
    exterior.add_gradient(device.upload(u), out)
    np.testing.assert_allclose(out.numpy(), exterior.rest_curvature() @ u, atol=1e-12)
    for value, at in zip(energy, (u + d, u - d), strict=True):
        exterior.energy(device.upload(at), value)
    rise = energy[0].numpy() - energy[1].numpy()
    np.testing.assert_allclose(rise, 2.0 * (out.numpy() * d).sum(axis=0), rtol=1e-12)
