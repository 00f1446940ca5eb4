"""What acts at a moment, in words: for panels and pages."""

from __future__ import annotations

import re

import numpy as np

from ar.overlay.hud import rounded_up
from sim.deformation import Deformation, Outcome
from sim.loads import Cause, Loads, Posture, Pushed, Resected, Retracted, Touching

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
