"""What `sulcus fit` says of patients whose tissue is known."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sim.loads import Pushed
from surrogate.fitting.fit import fit_from_evidence
from surrogate.fitting.observed_frame import ObservedFrame, Tool
from surrogate.fitting.responses import Responses, build_drained_loads, build_force_loads, solve_responses
from surrogate.fitting.tissue import CLASSES, FittedTissue
from surrogate.locating.locator import Locator

from .fit_twins import Patient, Seen, places
from .locate_study import PointsSeen, observed
from .locate_twins import ogden

NEAR, NEAR_YOUNG = 1.5, 1.2
"""Factors within which the tumour's stiffness, and Young's modulus, were wanted."""


@dataclass(frozen=True)
class Row:
    """All patients at one level of noise; shares in per cent.

    Parameters
    ----------
    factor, within
        Of the tumour's stiffness over the brain's: median factor that it is off by, and share within 1.5.
    held
        Share of the intervals of 95 % that hold it.
    sliding, skull
        Share of patients of which it was said rightly whether the skull holds the brain, and which skull it is.
    poisson
        Share whose class of Poisson's ratio was right.
    young, young_within, young_held, forces
        As the first three of Young's modulus, and of how many patients a force was read; None: of none.
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
class Library:
    """What is made once for a body: motions by drained fluid, and by tools on every place."""

    tools: Pushed
    drained: Responses
    pressed: Responses

    def pressed_on(self, chosen: Sequence[int]) -> Responses:
        """Those by tools on some places alone."""
        columns = (3 * np.array(chosen)[:, None] + np.arange(3)).ravel()
        return replace(self.pressed, motion={name: each[:, :, columns] for name, each in self.pressed.motion.items()})


def library_of(locator: Locator, device: str, folder: Path | None, progress: Callable[[int, int], object]) -> Library:
    """Solve it; what a `folder` keeps is read."""
    body, tools = locator.anatomy, places(locator.anatomy)
    drained = solve_responses(body, build_drained_loads(body), device, folder, progress)
    pressed = solve_responses(body, build_force_loads(body, tools.point, tools.footprint), device, folder, progress)
    return Library(tools, drained, pressed)


def fitted_to(
    locator: Locator, library: Library, seen: Seen, sight: PointsSeen, seed: int, read: bool, device: str
) -> FittedTissue:
    """What is said of one patient; the first tool's force is `read`, or none."""
    patient, frames = seen.patient, []
    for number, motion in enumerate(seen.motion):
        observation = observed(locator.anatomy, motion, sight, (seed, patient.number, number))
        frames.append(ObservedFrame(observation, _tools(library.tools, patient, number, read and not number)))
    pressed = library.pressed_on(patient.places) if patient.places else None
    return fit_from_evidence(locator, frames, library.drained, pressed, device)


def _tools(tools: Pushed, patient: Patient, number: int, read: bool) -> tuple[Tool, ...]:
    if number >= len(patient.places):
        return ()
    place = patient.places[number]
    x, y, z = tools.point[place].tolist()
    force = float(np.linalg.norm(patient.force[number])) if read else None
    return (Tool((x, y, z), float(tools.footprint[place]), force),)


def row(noise: int, said: Sequence[tuple[Patient, FittedTissue]]) -> Row:
    """How right it was."""
    ratio = [(patient.ratio, tissue.ratio) for patient, tissue in said]
    young = [(young_of(patient), tissue.stiffness) for patient, tissue in said if tissue.stiffness is not None]
    held = [(patient.skull == "bonded") == (tissue.skulls["bonded"] > 0.5) for patient, tissue in said]
    named = [max(tissue.skulls, key=lambda name: tissue.skulls[name]) == patient.skull for patient, tissue in said]
    edge = CLASSES["compressible"][1]
    classes = [(patient.poisson < edge) == (tissue.classes["compressible"] > 0.5) for patient, tissue in said]
    share = [100.0 * float(np.mean(each)) for each in (held, named, classes)]
    factor, within, inside = _off(ratio, NEAR)
    moduli = _off(young, NEAR_YOUNG) if young else (None, None, None)
    return Row(
        noise=noise, patients=len(said), factor=factor, within=within, held=inside, sliding=share[0], skull=share[1],
        poisson=share[2],
        young=moduli[0], young_within=moduli[1], young_held=moduli[2], forces=len(young),
    )  # fmt: skip


def young_of(patient: Patient) -> float:
    """Young's modulus [Pa] of a patient's brain at small strain."""
    tissue = ogden(patient.stiffness, patient.poisson)
    (c, _), *_ = tissue.terms
    return c * (1.0 + patient.poisson)


def _off(pairs: Sequence[tuple[float, tuple[float, float, float] | None]], near: float) -> tuple[float, float, float]:
    """Median factor off, share [%] within `near`, and share [%] within the interval."""
    table = np.array([[true, *(found or ())] for true, found in pairs])
    off = np.abs(np.log(table[:, 2] / table[:, 0]))
    held = (table[:, 1] <= table[:, 0]) & (table[:, 0] <= table[:, 3])
    return float(np.exp(np.median(off))), 100.0 * float(np.mean(off < np.log(near))), 100.0 * float(held.mean())
