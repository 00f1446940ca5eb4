"""What acts at a moment, in words: for panels and pages."""

from __future__ import annotations

import numpy as np

from sim.deformation import Deformation, Outcome
from sim.loads import Cause, Loads, Posture, Pushed, Resected, Retracted, Touching

# Sides of the body along the axes of RAS, and against them.
SIDES = ("RL", "AP", "SI")
# Components of a unit vector under this are not told.
TOLD = 0.05


# What is written into a picture whose answer may not be relied on.
DOUBTS = {
    Outcome.EXTRAPOLATED: "outside what the model learned: do not rely on it",
    Outcome.PIERCED: "the tool came to be inside the tissue: do not rely on it",
    Outcome.GUESSED: "nothing was solved: do not rely on it",
}


def doubt_of(outcome: Outcome) -> str:
    """Why an answer may not be relied on, in a few words for the picture; empty where it may."""
    return "" if outcome.good else DOUBTS.get(outcome, "not solved to the end: do not rely on it")


def told(loads: Loads, answer: Deformation) -> str:
    """What acts in the first load case, and its tool reads, as one line; empty where time alone goes on."""
    return ", ".join(words for words in (_words(cause, answer) for cause in loads.causes) if words)


def _words(cause: Cause, answer: Deformation) -> str:
    match cause:
        case Pushed():
            return f"force {np.linalg.norm(cause.force[0]):.2f} N"
        case Posture():
            down = cause.direction[0] / np.linalg.norm(cause.direction[0])
            ways = [
                f"{sides[int(x < 0.0)]} {abs(x):.2f}" for sides, x in zip(SIDES, down, strict=True) if abs(x) > TOLD
            ]
            return f"gravity towards {' '.join(ways)}, fluid up to {1e3 * cause.csf_level[0]:.0f} mm"
        case Resected():
            return f"resection: {cause.done[0]:.0f} steps done"
        case Touching() | Retracted() if answer.reaction.shape[1]:  # a learnt model does not know it
            return f"the tool reads {np.linalg.norm(answer.reaction[0, -1, :3]):.2f} N"
        case _:
            return ""
