"""Comparison of tissue laws with measured tension, compression and simple shear: fits, R2, errors, plots and a page."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from ar.screen import write_png
from sim.diagnostics.homogeneous import compute_shear_stress, compute_uniaxial_stress
from sim.errors import InputError
from sim.material import BRAIN, LAWS, Material, Ogden
from sim.named_tissues import MATERIALS
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
RANGES = {"tension": (1.0, 5.0), "compression": (0.2, 1.0), "shear": (0.0, 2.0)}
"""Allowed stretches or shear strains by test, which begin or end at the undeformed state."""
MAX_STRESS = 100.0  # Largest stress [kPa]; soft tissue has less, but numbers in Pa are larger.
REMEDY = (
    "Give comma-separated columns for one test or more: "
    + "; ".join(f"{strain} ({low:g} to {high:g}), {stress}" for (strain, stress), (low, high) in
                zip(COLUMNS.values(), RANGES.values(), strict=True))
    + ". Stress is nominal (force by undeformed area), negative in compression; shear strain is displacement by height."
)  # fmt: skip
MAX_BYTES = 1_000_000  # Largest size of a CSV file.
FITTED_POISSON = 0.4999  # Poisson's ratio of fitted laws: tests of brain are evaluated as incompressible.
EXPONENTS = [*range(-40, 0), *range(1, 41)]  # Exponents of Ogden's law from which a fit begins.
MIN_MU = 0.01  # Smallest fitted shear modulus [Pa].
FITTED = ("linear, fitted", "neo-hookean, fitted", "ogden, fitted")  # Fits in the plots.
NAMED = ("default", "brain", "grey", "white")  # Named tissues in the plots.
MIN_R2 = 0.9  # Smallest R2 of each test for which a law describes a tissue.
ABOUT = (
    "R2 = 1 - sum (model - measured)^2 / sum (measured - mean)^2 for each test; below 0: worse than a constant. Error: "
    "(model - measured) / measured nominal stress, at the largest measured stress. Fitted: one parameter set for all "
    "tests, by least squares of the stresses, nu 0.4999. Bold: R2 is at least 0.9 in each test. Other rows are the "
    "named tissues of `--material`, without relaxation. The corotational law is too stiff in shear at this nu, so that "
    "its fitted mu is far too small.",
    "mu is the shear modulus at small strain: E = 2 (1 + nu) mu. To use a fitted Ogden law with nu 0.49: --material "
    'ogden --ogden "2 mu,alpha" --bulk 49.7 mu, as numbers in Pa.',
    "This compares laws with samples outside the body, under one protocol. It says nothing about a patient.",
)


@dataclass(frozen=True)
class MeasuredTissue:
    """Measured curves of a tissue: by test, stretches or shear strains (n,), and nominal stresses (n,) [Pa]."""

    name: str
    tests: Mapping[str, tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class TissueFit:
    """Agreement of a law with a measured tissue by test: R2, and relative error at the largest measured stress.

    `mu`: shear modulus at small strain [Pa]; `alpha`: exponent of Ogden's law with one term, else None.
    """

    measured: str
    model: str
    tissue: str
    mu: float
    alpha: float | None
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
            reader = csv.DictReader(file, strict=True, skipinitialspace=True)
            rows, found = list(reader), reader.fieldnames or ()
        for names in COLUMNS.values():
            if lone := set(names) & set(found) if not set(names) <= set(found) else None:
                raise InputError(f"has a column {min(lone)} without {min(set(names) - lone)}. {REMEDY}")
        pairs = {test: [[row.get(name) for name in names] for row in rows] for test, names in COLUMNS.items()}
        tests = {test: _read_test(test, cells) for test, cells in pairs.items() if any(map(all, cells))}
        if not tests:
            raise InputError(f"has no row of a test; its columns are {', '.join(found)[:80]}. {REMEDY}")
        return MeasuredTissue(path.stem, tests)


def _read_test(test: str, cells: Sequence[Sequence[str | None]]) -> tuple[np.ndarray, np.ndarray]:
    """Return strains or stretches (n,) and stresses (n,) [Pa] of a test; rows with an empty cell are skipped."""
    names, (low, high) = COLUMNS[test], RANGES[test]
    try:
        strain, stress = np.array([[float(cell or "") for cell in pair] for pair in cells if all(pair)]).T
    except ValueError as error:
        raise InputError(f"{' and '.join(names)} need numbers: {str(error)[:80]}. {REMEDY}") from None
    if len(strain) < 3 or not np.ptp(stress) > 0.0:
        raise InputError(f"{names[1]} needs 3 or more rows with different numbers. {REMEDY}")
    if not ((strain >= low) & (strain <= high)).all():
        raise InputError(f"{names[0]} is {strain.min():g} to {strain.max():g}, outside its range. {REMEDY}")
    if not (np.abs(stress) <= MAX_STRESS).all():
        raise InputError(f"{names[1]} has a stress above {MAX_STRESS:g} kPa. {REMEDY}")
    if not (stress * (-1.0 if test == "compression" else 1.0)).sum() > 0.0:
        raise InputError(f"{names[1]} has the wrong sign. {REMEDY}")
    return strain, 1e3 * stress


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


def fit_law(law: str, measured_tissue: MeasuredTissue) -> Material | Ogden:
    """Fit one parameter set of a law to all tests by least squares of the stresses; `law` of `LAWS`, or Ogden's.

    Stresses are proportional to mu, so that mu follows from the other constants. Ogden's law has one term, whose
    exponent is the best of `EXPONENTS`, refined.

    Raises
    ------
    InputError
        See `compute_uniaxial_stress`; for Ogden's law, if no exponent has stresses.
    """
    target = np.concatenate([stress for _, stress in measured_tissue.tests.values()])

    def build(mu: float, alpha: float) -> Material | Ogden:
        if law != Ogden.law:
            return Material(law, 2.0 * (1.0 + FITTED_POISSON) * mu, FITTED_POISSON)
        bulk = 2.0 * mu * (1.0 + FITTED_POISSON) / (3.0 * (1.0 - 2.0 * FITTED_POISSON))
        return Ogden(((2.0 * mu, alpha),), bulk)

    def fit(alpha: float) -> tuple[float, float]:
        """Return the best mu [Pa] for an exponent, and the sum of squared differences."""
        unit = np.concatenate(list(compute_stresses(build(1.0, alpha), measured_tissue).values()))
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
        bounds = max(best - 0.9, min(EXPONENTS)), min(best + 0.9, max(EXPONENTS))
        found: Any = minimize_scalar(compute_misfit, bounds=bounds, method="bounded")
        best = float(found.x)
    return build(fit(best)[0], best)


def compare_tissue(name: str, tissue: Material | Ogden, measured_tissue: MeasuredTissue) -> TissueFit:
    """Compute R2 and errors of a tissue, for a row with the given name."""
    r2, error = {}, {}
    for test, stress in compute_stresses(tissue, measured_tissue).items():
        known = measured_tissue.tests[test][1]
        r2[test] = float(1.0 - np.square(stress - known).sum() / np.square(known - known.mean()).sum())
        last = np.abs(known).argmax()
        error[test] = float(stress[last] / known[last] - 1.0)
    alpha = tissue.terms[0][1] if isinstance(tissue, Ogden) and len(tissue.terms) == 1 else None
    return TissueFit(measured_tissue.name, name, str(tissue), tissue.lame[0], alpha, r2, error)


def list_tissues(measured_tissue: MeasuredTissue) -> dict[str, Material | Ogden]:
    """Return the fitted laws and the named tissues without relaxation, by the name of their row."""
    fitted = {f"{law}, fitted": fit_law(law, measured_tissue) for law in (*LAWS, Ogden.law)}
    named = {name: replace(each.tissue, prony=()) for name, each in MATERIALS.items()}
    return {**fitted, **{name: tissue for name, tissue in named.items() if name == "default" or tissue != BRAIN}}


def write_tissue_report(folder: Path, measured_tissues: Sequence[MeasuredTissue]) -> tuple[TissueFit, ...]:
    """Compare all tissues; write `index.html`, `tissue.json` and a plot of each measured tissue. Return the fits."""
    fits, body = [], []
    for each in measured_tissues:
        tissues = list_tissues(each)
        own = [compare_tissue(name, tissue, each) for name, tissue in tissues.items()]
        drawn = [name for name in tissues if name in (*FITTED, *NAMED)]
        found = {name: compute_stresses(tissues[name], each) for name in drawn}
        image, svg = draw_stress(
            {
                test: (strain, {MEASURED: stress, **{name: curves[test] for name, curves in found.items()}})
                for test, (strain, stress) in each.tests.items()
            },
            FITTED,
        )
        write_png(folder / f"{each.name}.png", image)
        heads = (
            "model",
            *(f"R2 {test}" for test in each.tests),
            *(f"error, {test}" for test in each.tests),
            "mu kPa",
            "alpha",
        )
        lines = []
        for fit in own:
            figures = *(f"{value:.2f}" for value in fit.r2.values()), *(f"{value:+.0%}" for value in fit.error.values())
            constants = f"{1e-3 * fit.mu:.3g}", "" if fit.alpha is None else f"{fit.alpha:.1f}"
            lines.append(("front" if fit.is_good else "", (fit.model, *figures, *constants)))
        body.append(f"<h2>{escape(each.name)}</h2><figure class=chart>{svg}</figure>{format_table(heads, lines)}")
        fits += own
    with write_atomically(folder / "tissue.json", ".json") as partial:
        partial.write_text(json.dumps([asdict(fit) for fit in fits]))
    with write_atomically(folder / "index.html", ".html") as partial:
        partial.write_text(format_page("Tissue laws and measured tissue", "".join(body), ABOUT))
    return tuple(fits)
