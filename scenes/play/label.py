"""The panel of figures in a frame's picture: what answered, how far the tumour moved, and what it took."""

from __future__ import annotations

import numpy as np

from ar.overlay.hud import HEAD, ROW, bound_words, panel

from .load_text import shortened
from .player import Frame
from .stage import DRAPE, TOOL

LINES = "green estimate, pink truth, blue 95 % of its middle"
"""What lines beside an estimate are."""


def label_lines(frame: Frame, name: str) -> list[str]:
    """What the panel says of a frame of a deformer, the most important first."""
    answer, found = frame.deformation, frame.estimate
    source, spent = shortened(answer.source or name), frame.seconds.items()
    doubt = [] if answer.outcome[0].good else [answer.outcome[0].value]
    moment = f"t {frame.time:.2f} s{', ' if frame.acts else ''}{frame.acts}"
    rest = [*doubt, moment, "ms: " + ", ".join(f"{stage} {1e3 * seconds:.1f}" for stage, seconds in spent)]
    if found is None:
        return [f"{name}: tumour moved {_within(frame.moved, frame.moved_error)}", *rest, source]
    moved = [f"truth: tumour moved {1e3 * found.truly:.2f} mm"]
    moved += [] if found.location is None else [f"estimate: tumour moved {_within(found.moved, frame.moved_error)}"]
    lines = [] if frame.named else [f"lines: {LINES}"]
    return [*moved, *rest, f"truth: {source}", f"estimate: {found.source}", *lines]


def _within(length: float, error: float | None) -> str:
    """A length and the tumour's error of it [m] in millimetres; where that is not known the picture's head says so."""
    return f"{1e3 * length:.2f} {'mm' if error is None else f'+- {bound_words(error, 1)}'}"


def labelled(frame: Frame, name: str) -> np.ndarray:
    """The shown picture (H, W, 3) with a panel: deformer, what acts, and milliseconds by stage; of an estimate too."""
    seen = frame.picture.segmentation
    # It hides cortex where it must, but no tool, no line and no word.
    hides = (frame.taken > 0) | (seen != DRAPE), (frame.taken > 0) | (seen == TOOL)
    sights = [each.view(np.uint8) for each in hides]
    return panel(frame.shown, label_lines(frame, name), below=HEAD + ROW * len(frame.head), sights=sights)
