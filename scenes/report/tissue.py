"""Comparison of tissue laws with measured tension, compression and simple shear: fits, R2, errors, plots and a page."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from html import escape
from pathlib import Path

import numpy as np
from scipy.optimize import minimize_scalar

from ar.screen import write_png
from sim.diagnostics.homogeneous import compute_shear_stress, compute_uniaxial_stress
from sim.errors import InputError
from sim.material import LAWS, MATERIALS, Material, Ogden
from sim.runtime.atomic_files import write_atomically
from sim.runtime.outside_files import wrap_errors

from ..analysis.stress_chart import MEASURED, draw_stress
from .page import format_page, format_table

COLUMNS = {
    "tension": ("stretch_tension", "stress_tension_kPa"),
    "compression": ("stretch_compression", "stress_compression_kPa"),
    "shear": ("shear_strain", "shear_stress_kPa"),
}
"""Columns of a CSV file by test: stretch or shear strain, and nominal stress [kPa]."""
REMEDY = f"Give CSV files with the columns {', '.join(name for pair in COLUMNS.values() for name in pair)}."
MAX_BYTES = 1_000_000  # Largest size of a CSV file.
FITTED_POISSON = 0.4999  # Poisson's ratio of fitted laws: tests of brain are evaluated as incompressible.
EXPONENTS = [*range(-40, 0), *range(1, 41)]  # Exponents of Ogden's law from which a fit begins.
MIN_MU = 0.01  # Smallest fitted shear modulus [Pa].
MIN_R2 = 0.9  # Smallest R2 of each test for which a law describes a tissue.
ABOUT = (
    "R2 = 1 - sum (model - measured)^2 / sum (measured - mean)^2 for each test; below 0: worse than a constant. Errors "
    "are of the nominal stress, where the largest was measured. Fitted: one parameter set for all tests, by least "
    "squares of the stresses, nu 0.4999. Bold: R2 is at least 0.9 in each test. Other rows are the named tissues, "
    "without relaxation.",
    "This compares laws with samples outside the body, under one protocol. It says nothing of a patient.",
)


@dataclass(frozen=True)
class MeasuredTissue:
    """Measured curves of a tissue: by test, stretches or shear strains (n,), and nominal stresses (n,) [Pa]."""

    name: str
    tests: Mapping[str, tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class TissueFit:
    """Agreement of a law with a measured tissue by test: R2, and relative error at the largest measured stress."""

    measured: str
    model: str
    tissue: str
    r2: Mapping[str, float]
    error: Mapping[str, float]

    @property
    def is_good(self) -> bool:
        """True if R2 is at least `MIN_R2` in each test."""
        return min(self.r2.values()) >= MIN_R2


def read_measured_tissues(folder: Path) -> tuple[MeasuredTissue, ...]:
    """Read a tissue from each CSV file of a folder.

    Raises
    ------
    InputError
        The folder has no CSV file; a file is too large, lacks a column, or has a value that is not valid.
    """
    paths = sorted(folder.glob("*.csv"))
    if not paths:
        raise InputError(f"{folder} is not a folder with .csv files. {REMEDY}")
    return tuple(_read_tissue(path) for path in paths)


def _read_tissue(path: Path) -> MeasuredTissue:
    with wrap_errors(path, "a table of measured stresses", REMEDY):
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"has more than {MAX_BYTES} bytes. {REMEDY}")
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = list(csv.DictReader(file, strict=True))
        tests = {}
        for test, names in COLUMNS.items():
            values = np.array([[float(row[name]) for name in names] for row in rows if row[names[0]]], float)
            if len(values) < 3 or not np.isfinite(values).all() or not np.ptp(values, axis=0).all():
                raise InputError(f"{test} needs 3 or more rows of finite numbers that are not all equal. {REMEDY}")
            tests[test] = values[:, 0], 1e3 * values[:, 1]
        return MeasuredTissue(path.stem, tests)


def compute_stresses(tissue: Material | Ogden, measured: MeasuredTissue) -> dict[str, np.ndarray]:
    """Compute the nominal stresses (n,) [Pa] of a tissue at the measured strains, by test.

    Raises
    ------
    InputError
        See `compute_uniaxial_stress`.
    """
    compute = {"shear": compute_shear_stress}
    return {
        test: compute.get(test, compute_uniaxial_stress)(tissue, strain) for test, (strain, _) in measured.tests.items()
    }


def fit_law(law: str, measured: MeasuredTissue) -> Material | Ogden:
    """Fit one parameter set of a law to all tests by least squares of the stresses; `law` of `LAWS`, or Ogden's.

    Stresses are proportional to mu, so that mu follows from the other constants. Ogden's law has one term, whose
    exponent is the best of `EXPONENTS`, refined.

    Raises
    ------
    InputError
        See `compute_uniaxial_stress`; for Ogden's law, if no exponent has stresses.
    """
    target = np.concatenate([stress for _, stress in measured.tests.values()])

    def build(mu: float, alpha: float) -> Material | Ogden:
        if law != Ogden.law:
            return Material(law, 2.0 * (1.0 + FITTED_POISSON) * mu, FITTED_POISSON)
        bulk = 2.0 * mu * (1.0 + FITTED_POISSON) / (3.0 * (1.0 - 2.0 * FITTED_POISSON))
        return Ogden(((2.0 * mu, alpha),), bulk)

    def fit(alpha: float) -> tuple[float, float]:
        """Return the best mu [Pa] for an exponent, and the sum of squared differences."""
        unit = np.concatenate(list(compute_stresses(build(1.0, alpha), measured).values()))
        mu = max(float(unit @ target / (unit @ unit)), MIN_MU)
        return mu, float(np.square(mu * unit - target).sum())

    def compute_misfit(alpha: float) -> float:
        try:
            return fit(alpha)[1]
        except InputError:
            return np.inf

    best = 2.0
    if law == Ogden.law:
        best = min(EXPONENTS, key=compute_misfit)
        best = float(minimize_scalar(compute_misfit, bounds=(best - 0.9, best + 0.9), method="bounded").x)
    return build(fit(best)[0], best)


def compare_tissue(name: str, tissue: Material | Ogden, measured: MeasuredTissue) -> TissueFit:
    """Compute R2 and errors of a tissue, for a row with the given name."""
    r2, error = {}, {}
    for test, stress in compute_stresses(tissue, measured).items():
        known = measured.tests[test][1]
        r2[test] = float(1.0 - np.square(stress - known).sum() / np.square(known - known.mean()).sum())
        last = np.abs(known).argmax()
        error[test] = float(stress[last] / known[last] - 1.0)
    return TissueFit(measured.name, name, str(tissue), r2, error)


def list_tissues(measured: MeasuredTissue) -> dict[str, Material | Ogden]:
    """Return the fitted laws and the named tissues without relaxation, by the name of their row."""
    fitted = {f"{law}, fitted": fit_law(law, measured) for law in (*LAWS, Ogden.law)}
    return {**fitted, **{name: replace(each.tissue, prony=()) for name, each in MATERIALS.items()}}


def write_tissue_report(folder: Path, measured: Sequence[MeasuredTissue]) -> tuple[TissueFit, ...]:
    """Compare all tissues; write `index.html`, `tissue.json` and a plot of each measured tissue. Return the fits."""
    fits, body = [], []
    for each in measured:
        tissues = list_tissues(each)
        own = [compare_tissue(name, tissue, each) for name, tissue in tissues.items()]
        fitted = {name: compute_stresses(tissue, each) for name, tissue in tissues.items() if "fitted" in name}
        image, svg = draw_stress(
            {
                test: (strain, {MEASURED: stress, **{name: curves[test] for name, curves in fitted.items()}})
                for test, (strain, stress) in each.tests.items()
            }
        )
        write_png(folder / f"{each.name}.png", image)
        heads = ("model", *(f"R2 {test}" for test in COLUMNS), *(f"error, {test}" for test in COLUMNS), "parameters")
        lines = [
            (
                "front" if fit.is_good else "",
                (fit.model, *(f"{value:.2f}" for value in fit.r2.values()),
                 *(f"{value:+.0%}" for value in fit.error.values()), fit.tissue),
            )
            for fit in own
        ]  # fmt: skip
        body.append(f"<h2>{escape(each.name)}</h2><figure class=chart>{svg}</figure>{format_table(heads, lines)}")
        fits += own
    with write_atomically(folder / "tissue.json", ".json") as partial:
        partial.write_text(json.dumps([asdict(fit) for fit in fits]))
    with write_atomically(folder / "index.html", ".html") as partial:
        partial.write_text(format_page("Tissue laws and measured tissue", "".join(body), ABOUT))
    return tuple(fits)
