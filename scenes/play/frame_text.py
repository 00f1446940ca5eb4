"""Text lines of a frame: active loads, error of the deformation model, and error of the tumour position."""

import re
from collections.abc import Sequence

import numpy as np

from ar.overlay.composite import Overlaid
from ar.overlay.hud import MAX_BOTTOM_WIDTH, format_bound, place_text, round_up, wrap_line
from sim.deformation import Deformation, Outcome
from sim.elements import OTHER_METHODS
from sim.families.registry import FAMILIES
from sim.loads import Cause, Loads, Posture, Pushed, Resected, Retracted, Touching

from ..script.uncertainty import REGISTRATION, TumourError
from .family_record import FamilyFigures

# Parts of the head in the positive and negative direction of each RAS axis.
SIDES = (("right", "left"), ("front", "back"), ("crown", "feet"))
MIN_NAMED_COMPONENT = 0.05  # Smallest component of a unit vector that is named.
# Pattern of the regions with own tissues, in the description by `Elasticity`.
OWN_TISSUES_PATTERN = re.compile(r"; region \d.*?(?=\)(?:;|$))")
REGION_PATTERN = re.compile(r"(?:(?<=; )|\()([\w ]+)\)?: ")  # Pattern of the name of one region.


OUTCOME_WARNINGS = {  # Warnings written into an image whose solution is unreliable.
    Outcome.EXTRAPOLATED: "outside the training range: do not rely on it",
    Outcome.PIERCED: "the tool penetrates the tissue: do not rely on it",
    Outcome.ON_BONE: "the tool stands on bone: do not rely on it",
    Outcome.INVERTED: "the mesh is inverted under this load: do not rely on it",
    Outcome.OVERSTRAINED: "strained beyond measured tissue: do not rely on it",
    Outcome.GUESSED: "no solution: do not rely on it",
}


def describe_outcome(outcome: Outcome) -> str:
    """Return the warning for an image that shows an unreliable solution; empty if the outcome is good."""
    return "" if outcome.good else OUTCOME_WARNINGS.get(outcome, "not solved to the end: do not rely on it")


def format_active_loads(loads: Loads, solution: Deformation, nodes: np.ndarray) -> str:
    """Format the active loads of the first load case, and the measured tool force, as one line; empty without loads.

    `nodes` (V, 3) [m] are the undeformed vertices of the brain: the CSF level is a percentage of the brain's height.
    """
    return ", ".join(words for words in (_describe_cause(cause, solution, nodes) for cause in loads.causes) if words)


def _describe_cause(cause: Cause, deformation: Deformation, nodes: np.ndarray) -> str:
    match cause:
        case Pushed():
            return f"force {np.linalg.norm(cause.force[0]):.2f} N" if cause.force[0].any() else "the tool does not push"
        case Posture():
            return f"gravity towards the {_name_direction(cause.direction[0])}, {_describe_fluid(cause, nodes)}"
        case Resected():
            steps = round(float(cause.done[0]))
            return f"resection: {steps} step{'' if steps == 1 else 's'} done"
        case Touching() | Retracted() if deformation.reaction.shape[1]:  # some trained models do not predict it
            bound = float(deformation.reaction_bound[0, 0])
            known = deformation.outcome[0].good and np.isfinite(bound)
            within = f" +- {round_up(bound, 2):.2f} N (surrogate)" if known else " N"
            return f"tool force {np.linalg.norm(deformation.reaction[0, -1, :3]):.2f}{within}"
        case _:
            return ""


def _name_direction(direction: np.ndarray) -> str:
    """Name the main RAS direction of a vector (3,), and its angles towards the others, as in "back, 30 deg left"."""
    down = direction / np.linalg.norm(direction)
    axes = [axis for axis in np.argsort(-np.abs(down), kind="stable") if abs(down[axis]) > MIN_NAMED_COMPONENT]
    names = [SIDES[axis][int(down[axis] < 0.0)] for axis in axes]
    angles = np.degrees(np.arcsin(np.abs(down[axes])))
    return "".join([names[0], *(f", {each:.0f} deg {name}" for name, each in zip(names[1:], angles[1:], strict=True))])


def _describe_fluid(cause: Posture, nodes: np.ndarray) -> str:
    """Describe the CSF level as a percentage of the brain's height along gravity."""
    height = -nodes @ (cause.direction[0] / np.linalg.norm(cause.direction[0]))
    share = float(np.clip((cause.csf_level[0] - height.min()) / np.ptp(height), 0.0, 1.0))
    return f"CSF level {100.0 * share:.0f} %"


def shorten_source(source: str) -> str:
    """Shorten `Deformation.source`: regions with their own tissue are listed by name only."""
    return OWN_TISSUES_PATTERN.sub(lambda found: f"; own tissue: {', '.join(REGION_PATTERN.findall(found[0]))}", source)


NOT_KNOWN_WORDS = "tumour position error: not known"


def format_errors(
    model_bound: float | None, tumour_error: TumourError, is_surrogate: bool, warning: str = "", is_brief: bool = False,
    figures: FamilyFigures | None = None,
) -> list[str]:  # fmt: skip
    """Build the lines for an image: error of the model (unless there is a warning or an observation), position error.

    An unreliable solution (`warning`) and an estimate from observations have only the tumour position error.

    Parameters
    ----------
    model_bound
        Error bound guaranteed by the model [m]; None if the model has no bound.
    is_surrogate
        True if another model than FEM computed the deformation.
    is_brief
        True for the short form, for a small image.
    figures
        Recorded figures of a model family other than FEM; their error replaces `model_bound`.
    """
    modelled = tumour_error.observed is None and not warning
    model = figures.describe_error(is_brief) if figures else format_model_error(model_bound, is_surrogate, is_brief)
    return [*([model] if modelled else []), format_tumour_error(tumour_error, is_brief)]


def is_by_other_family(deformation: Deformation) -> bool:
    """Return True if a model family other than FEM and trained models computed the deformation."""
    method = deformation.source.partition(" (")[0]
    return method in FAMILIES or method in OTHER_METHODS.values()


def format_model_error(bound: float | None, is_surrogate: bool, is_brief: bool = False) -> str:
    """Format the error bound [m] of a surrogate relative to FEM, or state that the result is the FEM reference."""
    if not is_surrogate:
        return "FEM reference" if is_brief else "FEM reference (no surrogate)"
    if bound is None:
        return "model: not known" if is_brief else "model error relative to FEM: not known"
    within = format_bound(bound, 2)
    return f"model <= {within}" if is_brief else f"surrogate error <= {within} (95 %, relative to FEM)"


def format_tumour_error(error: TumourError, is_brief: bool = False) -> str:
    """Format the error of the drawn tumour position relative to the position in the patient."""
    if error.bound is None:
        return "tumour: not known" if is_brief else NOT_KNOWN_WORDS
    within, guess = format_bound(error.bound, 1), ", rough estimate" if error.is_rough else ""
    if is_brief:
        return f"tumour <= {within}{guess if error.observed is None else ''}"
    said = f"tumour position error <= {within} (95 %)"
    of = error.registration_text
    if error.observed is None:
        if of and not guess and error.main_source == REGISTRATION:
            return f"{said}, {of}"
        return f"{said}{guess or f', mainly {error.main_source}'}{f'; {of}' * bool(of)}"
    said += f", {of}" * bool(of)
    return said if error.prior is None else f"{said}; without cortex observation: {format_bound(error.prior, 1)}{guess}"


def find_largest(errors: Sequence[TumourError]) -> TumourError:
    """Return the frame error with the largest bound; without bound if the bound of any frame is not available."""
    known = [error for error in errors if error.bound is not None]
    if len(known) < len(errors) or not known:
        return TumourError(None)
    return max(known, key=lambda error: error.bound or 0.0)


def annotate_image(overlaid: Overlaid, frame_number: int, remark: str) -> None:
    """Write a remark and the frame number at the bottom of a composite image (in place)."""
    height, width = overlaid.taken.shape
    place_text(overlaid.colour, overlaid.taken, wrap_line(remark, MAX_BOTTOM_WIDTH * width), (0, height))
    place_text(overlaid.colour, overlaid.taken, label_frame(frame_number), (width, height))


def label_frame(frame_number: int) -> list[str]:
    """Return the lines that label an image: its frame number, and a note that the image is simulated."""
    return [f"frame {frame_number}", "simulation"]
