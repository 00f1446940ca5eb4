"""Two errors in words, always apart: of the model against finite elements, and of the tumour against the patient."""

from __future__ import annotations

from collections.abc import Sequence

from ar.hud import rounded_up

from ..script.uncertainty import TumourError

NOT_KNOWN_WORDS = "error of the tumour: not known"


def error_lines(trained: bool, promised: float | None, error: TumourError, doubt: str = "") -> list[str]:
    """Lines for a picture: what the model is off by, and what the tumour is off by.

    The latter alone of a doubtful answer, and of one that is found from what is observed.

    Parameters
    ----------
    trained
        Whether a trained model answers, and not the finite elements.
    promised
        What the model promises [m]; None where nothing is.
    """
    modelled = trained or error.observed is None
    return [*([model_words(trained, promised)] if modelled and not doubt else []), tumour_words(error)]


def model_words(trained: bool, promised: float | None) -> str:
    """What the model is off by, against its finite elements."""
    if not trained:
        return "model: finite elements themselves"
    if promised is None:
        return "model: error against its finite elements not known"
    return f"model: within {length(promised, 2)} of its finite elements (95 %)"


def tumour_words(error: TumourError) -> str:
    """What the tumour is off by, against where it is in the patient."""
    if error.bound is None:
        return NOT_KNOWN_WORDS
    said = f"tumour: within {length(error.bound, 1)} of where it is (95 %)"
    if error.observed is None:
        return f"{said}, above all {error.largest}"
    return said if error.prior is None else f"{said}; without observation {length(error.prior, 1)}"


def length(metres: float, digits: int) -> str:
    """A bound in millimetres, rounded up: nothing is known to be without error."""
    return f"{max(rounded_up(1e3 * metres, digits), 10.0**-digits):.{digits}f} mm"


def worst(errors: Sequence[TumourError]) -> TumourError:
    """The largest of several frames' errors; not known where one is not."""
    known = [error for error in errors if error.bound is not None]
    if len(known) < len(errors) or not known:
        return TumourError(None)
    return max(known, key=lambda error: error.bound or 0.0)
