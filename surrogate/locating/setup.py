"""All that is made once for a patient, before anything is seen."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sim.anatomy import Anatomy
from sim.runtime.threads import one_thread

from .calibration import TRIALS, trials
from .causes import USUAL, Causes, pressed
from .ensemble import solved
from .locator import Locator
from .prior import PRESSED, prior_of
from .regions import check_regions


def make_locator(
    anatomy: Anatomy,
    seed: int = 0,
    device: str = "auto",
    causes: Causes = USUAL,
    folder: Path | None = None,
    progress: Callable[[str, int, int], object] = lambda stage, done, total: None,
    count: int = TRIALS,
) -> Locator:
    """A locator of one anatomy. Groups that a `folder` keeps from a run that was stopped are read.

    Regions that the `causes` know belong to the locator. `progress` hears a stage, how many of its parts are done, and
    of how many. `count` trials calibrate it.

    Raises
    ------
    InputError
        An anatomy without open cortex, tumour or skull, or without a region that the causes know; causes of which
        nothing converged.
    """
    check_regions(causes.regions, anatomy)
    ensemble = solved(anatomy, seed, device, causes, folder, lambda done, total: progress("causes", done, total))
    progress("forces on the cortex", 0, 1)
    presses = pressed(anatomy, tuple(dict.fromkeys(PRESSED.values())), device, causes.regions)
    with one_thread():  # products are small
        tried = trials(ensemble, presses, lambda done, total: progress("trials", done, total), count)
    return Locator(prior_of(ensemble, presses), tried, causes.regions)
