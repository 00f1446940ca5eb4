"""What each deformer of a theatre states about its error, and takes for a frame here: what a budget chooses from."""

from __future__ import annotations

import numpy as np

from surrogate.evaluation.choose import Offer
from surrogate.model.learned import Learned

from ..play.deformers import Theatre
from ..script.scene import Scene
from .live import PROMISED
from .stopwatch import timed

# Frames that are timed, after one that is not.
TIMED = 24


def offers(theatre: Theatre, scene: Scene) -> list[Offer]:
    """One offer for each deformer that states an error, timed on moments of the scene, as they are played."""
    made = []
    times = scene.times[np.linspace(0, len(scene.times) - 1, TIMED + 1).astype(int)]
    loads = [scene.loads(theatre.site, scene.path(float(time)), float(time)) for time in times]
    for name in theatre.names(scene):
        deformer = theatre.deformer(name, scene)
        learnt, seconds, last = isinstance(deformer, Learned), [], None
        error_mm = 1e3 * deformer.bound if isinstance(deformer, Learned) else 1e3 * PROMISED
        if np.isnan(error_mm):
            continue
        for load in loads:
            last, spent = timed(deformer.deform, load, start=None if learnt else last)
            seconds.append(spent)
        made.append(Offer(name, error_mm, 1e3 * float(np.median(seconds[1:]))))
    return made
