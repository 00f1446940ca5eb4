"""Finite-strain viscoelasticity: the deviatoric stress of any law relaxes by a Prony series, in time steps.

Simo 1987, "On a fully three-dimensional finite-strain viscoelastic damage model", Comput. Methods Appl. Mech. Eng.
60:153-173; Simo, Hughes 1998, "Computational Inelasticity", section 10.3; Holzapfel 2000, "Nonlinear Solid Mechanics",
section 6.10. The step is the derivative of an incremental potential: with Fb = J^(-1/3) F, Cb = Fb^T Fb,

    f psi(F) + (1 - f) psi(J^(1/3) I) + Cb : A / 2,  f = 1 - sum_i g_i (1 - exp(-dt / (2 tau_i))),
    A = sum_i (exp(-dt / tau_i) H_i - g_i exp(-dt / (2 tau_i)) S),

where S is the deviatoric stress of the law, pulled back by Fb of the last step, and H_i are the overstresses of Prony
terms. If a law splits into deviatoric and volumetric parts, as Ogden's law, psi(F) - psi(J^(1/3) I) is psi(Fb), as in
the papers. For other laws psi(Fb) must not be used: it grows faster than psi(F) under compression; tissue collapses.

The stable neo-Hookean law is finite at J = 0, but Cb is not, so any load on Cb causes collapse. This law has its own
split (`build_user_split`): mu relaxes, not K. The potential of a step is psi - (1 - f) psi_shape + C : A / 2, and S
acts on C = F^T F, as in finite linear viscoelasticity: Christensen 1980, "A Nonlinear Theory of Viscoelasticity for
Application to Elastomers", J. Appl. Mech. 47:762-768.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from ..discretisation.term import Cases
from ..material import Pairs
from ..runtime.device import Device, forward_kernel
from .laws.invariants import exp_less_one
from .laws.isochoric_split import build_law_split
from .laws.law import Law

# components of a symmetric tensor
TENSOR_COMPONENTS = 6


@cache
def build_relaxing_law(law: Law, device: Device, count: int) -> Law:
    """Return the law, based on `law` of `count` coefficients, that also takes f - 1 and xx, yy, zz, yz, zx, xy of A."""
    scalar, mat = device.scalar, device.matrix
    parts = build_law_split(law, device)
    inner, whole = (wp.types.vector(length=n, dtype=scalar) for n in (count, count + 1 + TENSOR_COMPONENTS))
    own_energy, own_stress, own_change = parts.energy, parts.stress, parts.stress_change

    @wp.func
    def get_law_coefficients(c: whole):
        """Return the coefficients of the wrapped law."""
        k = inner()
        for i in range(count):
            k[i] = c[i]
        return k

    @wp.func
    def get_tensor(c: whole):
        """Return the symmetric tensor A [Pa]."""
        xx, yy, zz, yz, zx, xy = (c[count + 1], c[count + 2], c[count + 3], c[count + 4], c[count + 5], c[count + 6])
        return mat(xx, xy, zx, xy, yy, yz, zx, yz, zz)

    @wp.func
    def energy(H: mat, c: whole):
        """Return the energy density of the step, psi + (f - 1) psi_shape + A : E [Pa]."""
        return own_energy(H, get_law_coefficients(c), c[count], get_tensor(c))

    @wp.func
    def stress(H: mat, c: whole):
        """Return the stress [Pa]: P + (f - 1) P_shape + the derivative of A : E."""
        return own_stress(H, get_law_coefficients(c), c[count], get_tensor(c))

    @wp.func
    def stress_change(H: mat, D: mat, c: whole):
        """Return dP [Pa] for dF = D, the derivative of `stress`."""
        return own_change(H, D, get_law_coefficients(c), c[count], get_tensor(c))

    @wp.func
    def get_rest_values(c: whole):
        """Return the coefficients without relaxation and overstress."""
        k = c
        for i in range(count, count + 1 + TENSOR_COMPONENTS):
            k[i] = scalar(0.0)
        return k

    return Law(f"viscoelastic {law.name}", energy, stress, stress_change, parts.needs_positive_volume, get_rest_values)


@dataclass(frozen=True)
class ViscoelasticKernels:
    """Kernels for one time step of the Prony series at every point."""

    write_relaxation: wp.Kernel
    update_history: wp.Kernel


@cache
def build_kernels(law: Law, device: Device, count: int) -> ViscoelasticKernels:
    """Return the kernels for a law with `count` coefficients, launched over (element, point, load case)."""
    scalar, mat, vec = device.scalar, device.matrix, device.vector
    constants = wp.types.vector(length=count, dtype=scalar)
    overstress = build_law_split(law, device).overstress
    six = TENSOR_COMPONENTS

    @forward_kernel(module="unique")
    def write_relaxation(
        ratio: wp.array2d(dtype=scalar),
        tau: wp.array2d(dtype=scalar),
        time_step: wp.array(dtype=scalar),
        history: wp.array3d(dtype=scalar),
        index: int,
        # outputs
        out: wp.array4d(dtype=scalar),
    ):
        """Compute f - 1 and A; `history` (b, points, 6 (n + 1)) contains S, then each H_i."""
        e, q, c = wp.tid()
        p = e * out.shape[1] + q
        less = scalar(0.0)
        for i in range(ratio.shape[1]):
            less += ratio[e, i] * exp_less_one(-time_step[c] / (scalar(2.0) * tau[e, i]))
        out[e, q, index, c] = less
        for k in range(six):
            pull = scalar(0.0)
            for i in range(ratio.shape[1]):
                half = wp.exp(-time_step[c] / (scalar(2.0) * tau[e, i]))
                pull += half * (half * history[c, p, six * (i + 1) + k] - ratio[e, i] * history[c, p, k])
            out[e, q, index + 1 + k, c] = pull

    @forward_kernel(module="unique")
    def update_history(
        ratio: wp.array2d(dtype=scalar),
        tau: wp.array2d(dtype=scalar),
        time_step: wp.array(dtype=scalar),
        history: wp.array3d(dtype=scalar),
        coefficients: wp.array(dtype=constants),
        strain: wp.array3d(dtype=mat),
        # outputs
        out: wp.array3d(dtype=scalar),
    ):
        """Update the history: S at H, and H_i <- exp(-dt / tau) H_i + g exp(-dt / (2 tau)) (S - last S)."""
        e, q, c = wp.tid()
        p = e * strain.shape[1] + q
        S = overstress(strain[e, q, c], coefficients[e])
        low, high = vec(S[0, 0], S[1, 1], S[2, 2]), vec(S[1, 2], S[2, 0], S[0, 1])
        for k in range(six):
            now = wp.where(k < 3, low[k % 3], high[k % 3])
            out[c, p, k] = now
            for i in range(ratio.shape[1]):
                half, row = wp.exp(-time_step[c] / (scalar(2.0) * tau[e, i])), six * (i + 1) + k
                out[c, p, row] = half * (half * history[c, p, row] + ratio[e, i] * (now - history[c, p, k]))

    return ViscoelasticKernels(write_relaxation, update_history)


class Prony:
    """Source for a Prony series; its history variables are S, then each H_i, (B, points, 6 (n + 1)) [Pa].

    Parameters
    ----------
    name
        Key of the history variables.
    law
        Law that relaxes, and its `coefficients` (T, k).
    pairs
        Series (g, tau [s]) of the tissue of each of T elements; lengths may differ.
    points
        Quadrature points per element.
    device
        Device of the arrays.
    """

    count = 1 + TENSOR_COMPONENTS

    def __init__(
        self, name: str, law: Law, coefficients: np.ndarray, pairs: Sequence[Pairs], points: int, device: Device
    ):
        self._name, self._device = name, device
        self._kernels = build_kernels(law, device, coefficients.shape[1])
        self._coefficients = device.upload(
            coefficients, wp.types.vector(length=coefficients.shape[1], dtype=device.scalar)
        )
        most = max(map(len, pairs))
        filled = np.array([(*row, *[(0.0, 1.0)] * (most - len(row))) for row in pairs]).reshape(-1, most, 2)
        self._series = [device.upload(filled[:, :, 0]), device.upload(filled[:, :, 1])]
        self.width = TENSOR_COMPONENTS * (most + 1)
        self._shape = len(coefficients) * points, self.width

    def build_law(self, base_law: Law, count: int) -> Law:
        """Return the law `base_law` with a relaxing deviatoric part."""
        return build_relaxing_law(base_law, self._device, count)

    def fill(self, cases: Cases, first_index: int, out: wp.array) -> None:
        """Write f - 1 and A at every point."""
        inputs = [*self._series, *self._get_history(cases), first_index]
        self._device.launch(self._kernels.write_relaxation, (*out.shape[:2], out.shape[3]), inputs, [out])

    def end(self, cases: Cases, strains: wp.array) -> np.ndarray:
        """Return the updated S and H_i."""
        out = self._device.allocate(len(cases.loads), *self._shape)
        inputs = [*self._series, *self._get_history(cases), self._coefficients, strains]
        self._device.launch(self._kernels.update_history, strains.shape, inputs, [out])
        return out.numpy()

    def _get_history(self, cases: Cases) -> list[wp.array]:
        """Return time steps (b,) [s] and the previous history (b, points, 6 (n + 1))."""
        return [self._device.upload(cases.steps), self._device.upload(cases.get_past(self._name, self._shape))]
