"""Two errors in words, always apart: of the model against finite elements, and of the tumour against the patient."""

from __future__ import annotations

from collections.abc import Sequence

from ar.overlay.hud import bound_words

from ..script.uncertainty import REGISTRATION, TumourError

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
