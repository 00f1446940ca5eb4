"""Fit a patient's tissue to several frames: their evidence in each tissue, added up."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from sim.anatomy import TUMOUR_LABEL
from sim.runtime.threads import one_thread

from ..locating.locator import Locator
from ..locating.observation import placed
from ..locating.regions import Region
from .frame import Frame, check_frames, foot
from .responses import POISSONS, RATIOS, Responses, drained_loads, force_loads, responses
from .stiffness import young_moduli
from .support import unsupported, without
from .tissue import FINE_POISSONS, FINE_RATIOS, FittedTissue
from .weighing import of_drained, of_pressed


def fit_tissue(
    locator: Locator,
    frames: Sequence[Frame],
    device: str = "auto",
    folder: Path | None = None,
    progress: Callable[[str, int, int], object] = lambda stage, done, total: None,
    left_out: Sequence[np.ndarray] | None = None,
) -> FittedTissue:
    """What is known of the tissue of a locator's anatomy, from some frames of it.

    Points that no other supports are left out: `left_out`, or what is found now. Finite elements that a `folder` keeps
    are read. `progress` hears a stage, how many of its parts are done, and of how many.

    Raises
    ------
    InputError
        As `check_frames` and `unsupported`.
    """
    anatomy = locator.anatomy
    check_frames(anatomy, frames)
    frames = without(frames, unsupported(locator, frames) if left_out is None else left_out)
    drained, pressed, regions = None, None, beside_tumour(locator)
    if any(not frame.tools for frame in frames):
        drained = responses(
            anatomy,
            drained_loads(anatomy),
            device,
            folder,
            lambda done, total: progress("drained fluid", done, total),
            regions,
        )
    tools = [tool for frame in frames for tool in frame.tools]
    if tools:
        at, radius = np.array([foot(anatomy, tool) for tool in tools]), np.array([tool.radius for tool in tools])
        pressed = responses(
            anatomy,
            force_loads(anatomy, at, radius),
            device,
            folder,
            lambda done, total: progress("tools", done, total),
            regions,
        )
    return fitted(locator, frames, drained, pressed, device, lambda done, total: progress("forces", done, total))


def fitted(
    locator: Locator,
    frames: Sequence[Frame],
    drained: Responses | None,
    pressed: Responses | None,
    device: str = "auto",
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> FittedTissue:
    """What frames say of the tissue, as `fit_tissue`, of what is solved; `progress` hears of forces that were read."""
    with one_thread():  # products are small
        probability = probability_of(weighed(locator, frames, drained, pressed))
    tissue = FittedTissue(locator.anatomy.digest, len(frames), probability, np.zeros(0))
    return replace(tissue, young=young_moduli(locator.anatomy, frames, tissue, pressed, device, progress))


def beside_tumour(locator: Locator) -> tuple[Region, ...]:
    """The regions that a locator knows, but the tumour, whose stiffness a fit finds."""
    return tuple(one for one in locator.regions if one.label != TUMOUR_LABEL)


def weighed(
    locator: Locator, frames: Sequence[Frame], drained: Responses | None, pressed: Responses | None
) -> np.ndarray:
    """Logarithms (skulls, poissons, ratios) of how probable all frames are in the tissues that were solved."""
    total, first = np.zeros((1, len(POISSONS), len(RATIOS))), 0
    for frame in frames:
        evidence, last = placed(locator.anatomy, frame.observation), first + 3 * len(frame.tools)
        if pressed is not None and frame.tools:
            total = total + of_pressed(pressed, np.arange(first, last), evidence)
        elif drained is not None:
            total = total + of_drained(drained, locator.prior, evidence)
        first = last
    return total


def probability_of(total: np.ndarray) -> np.ndarray:
    """Probabilities on the fine grid: logarithms are smooth in that of the ratio, and in how compressible it is."""
    fine = CubicSpline(np.log(RATIOS), total, axis=2)(np.log(FINE_RATIOS))
    order = np.argsort(1.0 - 2.0 * POISSONS)
    x, want = (1.0 - 2.0 * POISSONS)[order], 1.0 - 2.0 * FINE_POISSONS
    share = [np.prod([(want - x[k]) / (x[j] - x[k]) for k in range(3) if k != j], axis=0) for j in range(3)]
    fine = np.einsum("jp,sjr->spr", np.array(share), fine[:, order])
    weight = np.exp(fine - fine.max())
    return weight / weight.sum()
