"""Text of a frame: what acts, and both errors: of the model, and of the tumour in the patient."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from ar.overlay.hud import bound_words, rounded_up
from sim.deformation import Deformation, Outcome
from sim.loads import Cause, Loads, Posture, Pushed, Resected, Retracted, Touching

from ..script.uncertainty import REGISTRATION, TumourError

# Parts of the head along the axes of RAS, and against them.
SIDES = (("right", "left"), ("front", "back"), ("crown", "feet"))
# Components of a unit vector under this are not named.
NAMED = 0.05
# Regions with a tissue of their own, as `Elasticity` writes them, and the name of one.
OWN_TISSUES, OWN = re.compile(r"; region \d.*?(?=\)(?:;|$))"), re.compile(r"(?:(?<=; )|\()([\w ]+)\)?: ")


# What is written into a picture whose answer may not be relied on.
DOUBTS = {
    Outcome.EXTRAPOLATED: "outside what the model learned: do not rely on it",
    Outcome.PIERCED: "the tool came to be inside the tissue: do not rely on it",
    Outcome.ON_BONE: "the tool stands on bone: do not rely on it",
    Outcome.INVERTED: "the mesh is inverted under this load: do not rely on it",
    Outcome.OVERSTRAINED: "strained beyond measured tissue: do not rely on it",
    Outcome.GUESSED: "nothing was solved: do not rely on it",
}


def doubt_of(outcome: Outcome) -> str:
    """Why an answer may not be relied on, in a few words for the picture; empty where it may."""
    return "" if outcome.good else DOUBTS.get(outcome, "not solved to the end: do not rely on it")


def acting(loads: Loads, answer: Deformation, nodes: np.ndarray) -> str:
    """What acts in the first load case, and its tool reads, as one line; empty where time alone goes on.

    `nodes` (V, 3) [m] are the vertices of the brain at rest: it is said how much of its height stands in fluid.
    """
    return ", ".join(words for words in (_words(cause, answer, nodes) for cause in loads.causes) if words)


def _words(cause: Cause, answer: Deformation, nodes: np.ndarray) -> str:
    match cause:
        case Pushed():
            return f"force {np.linalg.norm(cause.force[0]):.2f} N" if cause.force[0].any() else "the tool does not push"
        case Posture():
            return f"gravity pulls to the {_way(cause.direction[0])}, {_fluid(cause, nodes)}"
        case Resected():
            steps = round(float(cause.done[0]))
            return f"resection: {steps} step{'' if steps == 1 else 's'} done"
        case Touching() | Retracted() if answer.reaction.shape[1]:  # some learnt models do not know it
            bound = float(answer.reaction_bound[0, 0])
            known = answer.outcome[0].good and np.isfinite(bound)
            within = f" within {rounded_up(bound, 2):.2f} N (model)" if known else ""
            return f"the tool reads {np.linalg.norm(answer.reaction[0, -1, :3]):.2f} N{within}"
        case _:
            return ""


def _way(direction: np.ndarray) -> str:
    """Where a direction (3,) of RAS points, the greatest part first, with its components where there are several."""
    down = direction / np.linalg.norm(direction)
    axes = [axis for axis in np.argsort(-np.abs(down), kind="stable") if abs(down[axis]) > NAMED]
    names = [SIDES[axis][int(down[axis] < 0.0)] for axis in axes]
    if len(axes) == 1:
        return names[0]
    return " and the ".join(f"{name} ({abs(down[axis]):.2f})" for name, axis in zip(names, axes, strict=True))


def _fluid(cause: Posture, nodes: np.ndarray) -> str:
    """How high the fluid stands, as a share of the brain's height."""
    height = -nodes @ (cause.direction[0] / np.linalg.norm(cause.direction[0]))
    share = float(np.clip((cause.csf_level[0] - height.min()) / np.ptp(height), 0.0, 1.0))
    return f"fluid up to {100.0 * share:.0f} % of the brain's height"


def shortened(source: str) -> str:
    """What answers, as `Deformation.source` has it, with regions of a tissue of their own by name alone."""
    return OWN_TISSUES.sub(lambda found: f"; own tissue: {', '.join(OWN.findall(found[0]))}", source)


NOT_KNOWN_WORDS = "error of the tumour: not known"


def error_lines(
    promised: float | None, error: TumourError, trained: bool, doubt: str = "", brief: bool = False
) -> list[str]:
    """Lines for a picture: what the model is off by, and what the tumour is off by.

    The latter alone of a doubtful answer, and of one that is found from what is observed.

    Parameters
    ----------
    promised
        What the model promises [m]; None where nothing is.
    trained
        Whether a trained model answers, and not the finite elements.
    brief
        Whether in few words, for a small picture.
    """
    modelled = error.observed is None and not doubt
    return [*([model_words(promised, trained, brief)] if modelled else []), tumour_words(error, brief)]


def model_words(promised: float | None, trained: bool, brief: bool = False) -> str:
    """What the model is off by, against its finite elements."""
    if not trained:
        return "model: FEM itself" if brief else "model: finite elements themselves"
    if promised is None:
        return "model: not known" if brief else "model: error against its finite elements not known"
    within = f"model: within {bound_words(promised, 2)}"
    return within if brief else f"{within} of its finite elements (95 %)"


def tumour_words(error: TumourError, brief: bool = False) -> str:
    """What the tumour is off by, against where it is in the patient."""
    if error.bound is None:
        return "tumour: not known" if brief else NOT_KNOWN_WORDS
    within, guess = f"tumour: within {bound_words(error.bound, 1)}", ", a guess" if error.guess else ""
    if brief:
        return within if error.observed is not None else f"{within}{guess}"
    said = f"{within} of where it is (95 %)"
    of = error.registration_words
    if error.observed is None:
        if of and not guess and error.largest == REGISTRATION:
            return f"{said}, {of}"
        return f"{said}{guess or f', above all {error.largest}'}{f'; {of}' * bool(of)}"
    said += f", {of}" * bool(of)
    return said if error.prior is None else f"{said}; without observation {bound_words(error.prior, 1)}{guess}"


def worst(errors: Sequence[TumourError]) -> TumourError:
    """The largest of several frames' errors; not known where one is not."""
    known = [error for error in errors if error.bound is not None]
    if len(known) < len(errors) or not known:
        return TumourError(None)
    return max(known, key=lambda error: error.bound or 0.0)
