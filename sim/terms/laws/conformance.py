"""Checks that a material law, also a user-defined law, satisfies the requirements of the solver."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from ...errors import InputError
from ...material import Tissue, get_lame
from ...runtime.device import Device, Precision, find_device, forward_kernel
from .law import Law


@dataclass(frozen=True)
class TestStrains:
    """Random strains at which a law is checked.

    Parameters
    ----------
    count
        Number of random displacement gradients.
    large_deviation, small_deviation, float32_deviation
        Standard deviation of the gradients at large strain, at small strain, and in single precision.
    energy_step, stress_step
        Step of the central differences of the energy, and of the stress.
    """

    count: int = 60
    large_deviation: float = 0.3
    small_deviation: float = 1e-6
    float32_deviation: float = 1e-3
    energy_step: float = 1e-5
    stress_step: float = 1e-6


@dataclass(frozen=True)
class LawEvaluation:
    """Results of a law: energies (n,), stresses (n, 3, 3) and stress changes (n, 3, 3), all in Pa."""

    energy: np.ndarray
    stress: np.ndarray
    change: np.ndarray


@dataclass(frozen=True)
class Evaluator:
    """Evaluator of the Warp functions of a law for arrays of displacement gradients; `tissue` is the default tissue."""

    device: Device
    kernel: wp.Kernel
    tissue: Tissue

    def __call__(self, H: np.ndarray, D: np.ndarray | None = None, tissue: Tissue | None = None) -> LawEvaluation:
        """Return the results at displacement gradients H (n, 3, 3) with increments D (n, 3, 3)."""
        return self.evaluate(H, D, (tissue or self.tissue).coefficients)

    def evaluate(self, H: np.ndarray, D: np.ndarray | None, coefficients: tuple[float, ...]) -> LawEvaluation:
        """Return the results at H (n, 3, 3) with increments D (n, 3, 3) and other coefficients."""
        count, device = len(H), self.device
        energy = device.allocate(count)
        stress, change = (wp.zeros(count, dtype=device.matrix, device=device.name) for _ in range(2))
        given = device.upload(H, device.matrix), device.upload(H if D is None else D, device.matrix)
        constants = wp.types.vector(len(coefficients), device.scalar)(*coefficients)
        device.launch(self.kernel, (count,), [*given, constants], [energy, stress, change])
        return LawEvaluation(*(array.numpy().astype(np.float64) for array in (energy, stress, change)))


def build_evaluator(tissue: Tissue, precision: Precision) -> Evaluator:
    """Return the evaluator of the law of a tissue, on the CPU."""
    device = find_device("cpu", precision)
    return Evaluator(device, _build_kernel(tissue.functions, len(tissue.coefficients), device), tissue)


@cache
def _build_kernel(law: Law, count: int, device: Device) -> wp.Kernel:
    """Return the kernel that evaluates a law with `count` coefficients; tissues of the same law share the kernel."""
    scalar, mat = device.scalar, device.matrix
    constants = wp.types.vector(count, scalar)
    density, stress_of, change_of = law.energy, law.stress, law.stress_change

    @forward_kernel(module="unique")
    def evaluate(
        H: wp.array(dtype=mat),
        D: wp.array(dtype=mat),
        c: constants,
        # outputs
        energy: wp.array(dtype=scalar),
        stress: wp.array(dtype=mat),
        change: wp.array(dtype=mat),
    ):
        """Evaluate psi, P and dP."""
        i = wp.tid()
        energy[i] = density(H[i], c)
        stress[i] = stress_of(H[i], c)
        change[i] = change_of(H[i], D[i], c)

    return evaluate


@dataclass(frozen=True)
class Finding:
    """Result of one check of a law: relative error, and limit of this error."""

    name: str
    error: float
    limit: float

    @property
    def is_within_limit(self) -> bool:
        """True if the error does not exceed its limit; False for NaN."""
        return self.error <= self.limit

    def __str__(self) -> str:
        return f"{self.name}: relative error {self.error:.1e}, limit {self.limit:.0e}"


def check_tissue(
    tissue: Tissue, small_strain: bool = False, strains: TestStrains = TestStrains()
) -> tuple[Finding, ...]:
    """Check the law of a tissue at random strains on the CPU, and return all findings; compilation takes seconds.

    If `small_strain`, the law is for small rotations only, as Hooke's law, and need not be objective.

    Raises
    ------
    InputError
        A check has failed; the message lists all failed checks and their errors.
    """
    with np.errstate(invalid="ignore"):  # infinity - infinity is NaN, which fails the check
        found = tuple(_iterate_findings(tissue, small_strain, strains))
    broken = [str(finding) for finding in found if not finding.is_within_limit]
    if broken:
        raise InputError(f"the law {tissue.law} does not hold: {'; '.join(broken)}.")
    return found


def _iterate_findings(tissue: Tissue, small_strain: bool, strains: TestStrains) -> Iterator[Finding]:
    count, step = strains.count, strains.stress_step
    mu, lam = tissue.lame
    if not (mu > 0.0 and 3.0 * lam + 2.0 * mu > 0.0 and np.isfinite([mu, lam]).all()):
        raise InputError(
            f"the law {tissue.law} has the Lamé constants {mu}, {lam} Pa: the undeformed state would be unstable."
        )
    given, again = np.array(tissue.coefficients), np.array(tissue.coefficients_at(mu, lam))
    if given.shape != again.shape:
        raise InputError(
            f"the law {tissue.law} has {len(given)} coefficients, but {len(again)} at other Lamé parameters: "
            "must be equal."
        )
    yield Finding("coefficients_at its own Lamé constants are its coefficients", _compute_error(again, given), 1e-12)
    double, random = build_evaluator(tissue, "float64"), np.random.default_rng(3)
    H = random.normal(0.0, strains.large_deviation, (3 * count, 3, 3))
    J = np.linalg.det(np.eye(3) + H)
    positive = tissue.functions.needs_positive_volume
    H = H[J > 0.1][:count] if positive else H[np.abs(J) > 0.02][:count]
    D, E = random.normal(size=(2, *H.shape))
    here = double(H, D)

    still = double(np.zeros((1, 3, 3)))
    yield Finding("no energy and no stress at rest", max(_find_largest(still.stress), abs(still.energy[0])) / mu, 1e-9)
    small = random.normal(0.0, strains.small_deviation, (count, 3, 3))
    for carries in ("whole", "shape", "volume"):
        share = get_lame(tissue, carries)
        stress = double.evaluate(small, None, tissue.coefficients_at(*share)).stress
        name = "" if carries == "whole" else f" where elements carry {carries} alone"
        yield Finding(
            f"Hooke's law at small strain{name}", _compute_error(stress, compute_hooke_stress(small, *share)), 1e-4
        )
    parts = [
        double.evaluate(H, D, tissue.coefficients_at(*get_lame(tissue, carries))) for carries in ("shape", "volume")
    ]
    for name in ("energy", "stress", "change"):
        shape, volume = (getattr(part, name) for part in parts)
        yield Finding(
            f"shape and volume make the whole {name}", _compute_error(shape + volume, getattr(here, name)), 1e-8
        )

    numeric = np.zeros_like(H)
    for i, j in np.ndindex(3, 3):
        one = np.zeros((3, 3))
        one[i, j] = strains.energy_step
        numeric[:, i, j] = (double(H + one).energy - double(H - one).energy) / (2.0 * strains.energy_step)
    yield Finding("stress is the energy's derivative", _compute_error(numeric, here.stress), 1e-6)
    numeric = (double(H + step * D).stress - double(H - step * D).stress) / (2.0 * step)
    yield Finding("stress_change is the stress's derivative", _compute_error(numeric, here.change), 1e-6)
    one, other = (np.einsum("nij,nij->n", change, way) for change, way in ((here.change, E), (double(H, E).change, D)))
    yield Finding("stress_change is symmetric", _compute_error(other, one), 1e-8)

    Q, _ = np.linalg.qr(random.normal(size=H.shape))
    Q *= np.linalg.det(Q)[:, None, None]
    turned = double(Q @ H @ Q.transpose(0, 2, 1)).energy
    yield Finding("isotropic: the axes do not matter", _compute_error(turned, here.energy), 1e-8)
    if not small_strain:
        turned = double(Q @ (np.eye(3) + H) - np.eye(3)).stress
        yield Finding("stress turns with the tissue", _compute_error(turned, Q @ here.stress), 1e-8)
    if positive:
        inverted = double(np.diag([-2.0, 0.0, 0.0])[None]).energy[0]
        yield Finding(
            "infinite energy where J < 0, which needs_positive_volume requires", float(inverted < np.inf), 0.0
        )
    single = build_evaluator(tissue, "float32")
    strained = random.normal(0.0, strains.float32_deviation, (count, 3, 3)).astype(np.float32).astype(np.float64)
    yield Finding("stress in single precision", _compute_error(single(strained).stress, double(strained).stress), 1e-3)


def compute_hooke_stress(H: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """Return Hooke's stress (n, 3, 3) [Pa] at displacement gradients (n, 3, 3), with Lamé parameters [Pa]."""
    trace = np.trace(H, axis1=1, axis2=2)[:, None, None]
    return mu * (H + H.transpose(0, 2, 1)) + lam * trace * np.eye(3)


def _find_largest(values: np.ndarray) -> float:
    return float(np.abs(values).max())


def _compute_error(values: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest difference between `values` and `expected`, relative to the largest value of `expected`."""
    return _find_largest(values - expected) / max(_find_largest(expected), np.finfo(float).tiny)
