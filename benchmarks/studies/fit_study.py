"""Errors of `sulcus fit` on synthetic patients of known tissue."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sim.loads import Pushed
from surrogate.fitting.fit import fit_tissue_from_responses
from surrogate.fitting.observed_frame import ObservedFrame, Tool
from surrogate.fitting.responses import Responses, build_drainage_loads, build_force_loads, solve_responses
from surrogate.fitting.tissue import CLASSES, FittedTissue
from surrogate.locating.locator import Locator

from .fit_twins import Patient, PatientMotions, sample_positions
from .locate_study import PointModel, sample_observation
from .locate_twins import build_ogden_tissue

NEAR, NEAR_YOUNG = 1.5, 1.2
"""Target factors on the errors of the tumour's stiffness, and of Young's modulus."""


@dataclass(frozen=True)
class FitRow:
    """Results of all patients at one level of noise; shares in percent.

    Parameters
    ----------
    factor, within
        Stiffness ratio of tumour to brain: median error as a factor, and share of patients with a factor within 1.5.
    held
        Share of the 95 % intervals that cover the stiffness ratio.
    sliding, skull
        Shares of patients with a correct decision between bonded and sliding skull, and with the correct skull.
    poisson
        Share of patients with the correct class of Poisson's ratio.
    young, young_within, young_held, forces
        `factor`, `within` and `held` of Young's modulus; number of patients with a measured force. None: no force.
    """

    noise: int
    patients: int
    factor: float
    within: float
    held: float
    sliding: float
    skull: float
    poisson: float
    young: float | None
    young_within: float | None
    young_held: float | None
    forces: int


@dataclass(frozen=True, eq=False)
class ResponseLibrary:
    """Responses computed once for a body: motions by drained fluid, and by tools at every position."""

    tools: Pushed
    drainage: Responses
    pressing: Responses

    def select_positions(self, positions: Sequence[int]) -> Responses:
        """Return the responses to tools at some positions alone."""
        columns = (3 * np.array(positions)[:, None] + np.arange(3)).ravel()
        return replace(self.pressing, motion={name: each[:, :, columns] for name, each in self.pressing.motion.items()})


def solve_library(
    locator: Locator, device: str, folder: Path | None, progress: Callable[[int, int], object]
) -> ResponseLibrary:
    """Solve the library of a locator's anatomy; results in `folder` are read."""
    body, tools = locator.anatomy, sample_positions(locator.anatomy)
    drained = solve_responses(body, build_drainage_loads(body), device, folder, progress)
    pressed = solve_responses(body, build_force_loads(body, tools.point, tools.footprint), device, folder, progress)
    return ResponseLibrary(tools, drained, pressed)


def fit_patient(
    locator: Locator, library: ResponseLibrary, seen: PatientMotions, observation_model: PointModel, seed: int,
    with_force: bool, device: str,
) -> FittedTissue:  # fmt: skip
    """Fit the tissue of one patient; the first tool's force is measured if `with_force`."""
    patient, frames = seen.patient, []
    for number, motion in enumerate(seen.motion):
        observation = sample_observation(locator.anatomy, motion, observation_model, (seed, patient.number, number))
        frames.append(ObservedFrame(observation, _tools(library.tools, patient, number, with_force and not number)))
    pressed = library.select_positions(patient.places) if patient.places else None
    return fit_tissue_from_responses(locator, frames, library.drainage, pressed, device)


def _tools(tools: Pushed, patient: Patient, number: int, read: bool) -> tuple[Tool, ...]:
    if number >= len(patient.places):
        return ()
    place = patient.places[number]
    x, y, z = tools.point[place].tolist()
    force = float(np.linalg.norm(patient.force[number])) if read else None
    return (Tool((x, y, z), float(tools.footprint[place]), force),)


def summarise_fits(noise: int, fits: Sequence[tuple[Patient, FittedTissue]]) -> FitRow:
    """Summarise the fits at one level of noise."""
    ratio = [(patient.ratio, tissue.ratio) for patient, tissue in fits]
    young = [(get_young_modulus(patient), tissue.stiffness) for patient, tissue in fits if tissue.stiffness is not None]
    held = [(patient.skull == "bonded") == (tissue.skulls["bonded"] > 0.5) for patient, tissue in fits]
    named = [max(tissue.skulls, key=lambda name: tissue.skulls[name]) == patient.skull for patient, tissue in fits]
    edge = CLASSES["compressible"][1]
    classes = [(patient.poisson < edge) == (tissue.classes["compressible"] > 0.5) for patient, tissue in fits]
    share = [100.0 * float(np.mean(each)) for each in (held, named, classes)]
    factor, within, inside = _off(ratio, NEAR)
    moduli = _off(young, NEAR_YOUNG) if young else (None, None, None)
    return FitRow(
        noise=noise, patients=len(fits), factor=factor, within=within, held=inside, sliding=share[0], skull=share[1],
        poisson=share[2],
        young=moduli[0], young_within=moduli[1], young_held=moduli[2], forces=len(young),
    )  # fmt: skip


def get_young_modulus(patient: Patient) -> float:
    """Return Young's modulus [Pa] of a patient's brain at small strain."""
    tissue = build_ogden_tissue(patient.stiffness, patient.poisson)
    (c, _), *_ = tissue.terms
    return c * (1.0 + patient.poisson)


def _off(pairs: Sequence[tuple[float, tuple[float, float, float] | None]], near: float) -> tuple[float, float, float]:
    """Compute the median error as a factor, the share [%] within `near`, and the share [%] in the interval."""
    table = np.array([[true, *(found or ())] for true, found in pairs])
    off = np.abs(np.log(table[:, 2] / table[:, 0]))
    held = (table[:, 1] <= table[:, 0]) & (table[:, 0] <= table[:, 3])
    return float(np.exp(np.median(off))), 100.0 * float(np.mean(off < np.log(near))), 100.0 * float(held.mean())
