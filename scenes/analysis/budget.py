"""Reported error and measured frame time of each deformation model: the choices of a budget."""

import numpy as np

from sim.deformation import Deformer
from surrogate.evaluation.choose import Offer
from surrogate.model.guarded import Guarded
from surrogate.model.learned import Learned

from ..play.deformers import PatientSetup
from ..script.scene import Scene
from .measurement import time_work

TIMED_FRAMES = 24  # Number of frames that are timed, after one that is not.
MAX_LIVE_ERROR = 5e-5  # Largest distance of a node from the converged solution at the accuracy LIVE [m].


def time_offers(theatre: PatientSetup, scene: Scene) -> list[Offer]:
    """Time each deformer that reports an error, on frames of the scene in playing order."""
    made = []
    times = scene.times[np.linspace(0, len(scene.times) - 1, TIMED_FRAMES + 1).astype(int)]
    loads = [scene.build_loads(theatre.site, scene.path(float(time)), float(time)) for time in times]
    for name in theatre.list_deformers(scene):
        deformer = theatre.build_deformer(name, scene)
        forgets = isinstance(deformer, Learned) and not deformer.series
        seconds, last = [], None
        error_mm = 1e3 * _get_reported_error(deformer)
        if np.isnan(error_mm):
            continue
        for load in loads:
            last, spent = time_work(deformer.deform, load, start=None if forgets else last)
            seconds.append(spent)
        made.append(Offer(name, error_mm, 1e3 * float(np.median(seconds[1:]))))
    return made


def _get_reported_error(deformer: Deformer) -> float:
    """Return the error [m] that a deformer reports; NaN without one."""
    if isinstance(deformer, Guarded):
        return float(np.fmin(deformer.model.bound, deformer.limit))
    return deformer.bound if isinstance(deformer, Learned) else MAX_LIVE_ERROR
