"""Tissue swelling by blood volume: any law, applied to F / (1 + theta)^(1/3); pure swelling causes no stress.

Rodriguez, Hoger, McCulloch 1994, "Stress-dependent finite growth in soft elastic tissues", J. Biomech. 27:455-467, with
isotropic growth: psi per undeformed volume is (1 + theta) psi(F_e), F = (1 + theta)^(1/3) F_e.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from ..discretisation.term import Cases
from ..runtime.device import Device, forward_kernel
from .laws.law import Law


@cache
def build_swollen_law(law: Law, device: Device, count: int) -> Law:
    """Return the law, based on `law` with `count` coefficients, that also takes r = (1 + theta)^(1/3) - 1."""
    scalar, mat = device.scalar, device.matrix
    inner, whole = (wp.types.vector(length=n, dtype=scalar) for n in (count, count + 1))
    own_energy, own_stress, own_change = law.energy, law.stress, law.stress_change

    @wp.func
    def get_law_coefficients(c: whole):
        """Return the coefficients of the wrapped law."""
        k = inner()
        for i in range(count):
            k[i] = c[i]
        return k

    @wp.func
    def compute_elastic_part(H: mat, c: whole):
        """Return the elastic displacement gradient F_e - I = (H - r I) / (1 + r)."""
        return (H - c[count] * wp.identity(n=3, dtype=scalar)) / (scalar(1.0) + c[count])

    @wp.func
    def energy(H: mat, c: whole):
        """Return the energy density (1 + r)^3 psi(F_e) [Pa]."""
        s = scalar(1.0) + c[count]
        return s * s * s * own_energy(compute_elastic_part(H, c), get_law_coefficients(c))

    @wp.func
    def stress(H: mat, c: whole):
        """Return the stress P = (1 + r)^2 P(F_e) [Pa]."""
        s = scalar(1.0) + c[count]
        return s * s * own_stress(compute_elastic_part(H, c), get_law_coefficients(c))

    @wp.func
    def stress_change(H: mat, D: mat, c: whole):
        """Return dP [Pa] for dF = D: (1 + r) dP(F_e; D)."""
        return (scalar(1.0) + c[count]) * own_change(compute_elastic_part(H, c), D, get_law_coefficients(c))

    @wp.func
    def return_coefficients(k: inner):
        """Return the coefficients unchanged."""
        return k

    own_rest = law.at_rest or return_coefficients

    @wp.func
    def get_rest_values(c: whole):
        """Return the coefficients in the undeformed state: those of the wrapped law, and r = 0."""
        k, own = whole(), own_rest(get_law_coefficients(c))
        for i in range(count):
            k[i] = own[i]
        return k

    return Law(f"swelling {law.name}", energy, stress, stress_change, law.needs_positive_volume, get_rest_values)


@dataclass(frozen=True)
class SwellingKernels:
    """Kernels for the swelling ratio, launched over (element, point, load case)."""

    write_ratio: wp.Kernel
    remove_swelling: wp.Kernel


@cache
def build_kernels(device: Device) -> SwellingKernels:
    """Return the kernels for the scalar type of a device."""
    scalar, mat = device.scalar, device.matrix

    @forward_kernel(module="unique")
    def write_ratio(
        mask: wp.array(dtype=scalar),
        ratio: wp.array(dtype=scalar),
        index: int,
        # outputs
        out: wp.array4d(dtype=scalar),
    ):
        """Write the swelling ratio r_eqc = s_e r_c."""
        e, q, c = wp.tid()
        out[e, q, index, c] = mask[e] * ratio[c]

    @forward_kernel(module="unique")
    def remove_swelling(
        mask: wp.array(dtype=scalar),
        ratio: wp.array(dtype=scalar),
        # outputs
        strain: wp.array3d(dtype=mat),
    ):
        """Replace H by the elastic part F_e - I = (H - r I) / (1 + r)."""
        e, q, c = wp.tid()
        r = mask[e] * ratio[c]
        strain[e, q, c] = (strain[e, q, c] - r * wp.identity(n=3, dtype=scalar)) / (scalar(1.0) + r)

    return SwellingKernels(write_ratio, remove_swelling)


class Swelling:
    """Source of the relative volume change theta of swelling tissue, without history variables.

    Parameters
    ----------
    theta
        Function of times (B,) [s] that returns the relative volume increase theta (B,).
    swells
        Mask (T,) of elements that swell.
    device
        Device of the arrays.
    """

    count, width = 1, 0

    def __init__(self, theta: Callable[[np.ndarray], np.ndarray], mask: np.ndarray, device: Device):
        self._theta, self._device = theta, device
        self._swells = device.upload(mask.astype(np.float64))

    def build_law(self, base_law: Law, count: int) -> Law:
        """Return the law that applies `base_law` to the elastic part of the deformation."""
        return build_swollen_law(base_law, self._device, count)

    def fill(self, cases: Cases, first_index: int, out: wp.array) -> None:
        """Write the ratio r at every point."""
        inputs = [self._swells, self._compute_linear_strain(cases), first_index]
        self._device.launch(build_kernels(self._device).write_ratio, (*out.shape[:2], out.shape[3]), inputs, [out])

    def end(self, cases: Cases, strains: wp.array) -> None:
        """Replace strains by their elastic part for inner sources; return None, since there is no history."""
        inputs = [self._swells, self._compute_linear_strain(cases)]
        self._device.launch(build_kernels(self._device).remove_swelling, strains.shape, inputs, [strains])

    def _compute_linear_strain(self, cases: Cases) -> wp.array:
        """Return the ratio r (b,), also accurate for small theta."""
        return self._device.upload(np.expm1(np.log1p(self._theta(cases.loads.times)) / 3.0))
