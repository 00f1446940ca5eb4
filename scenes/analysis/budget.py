"""Choice of a deformation model by its reported error and its measured time per frame."""

from collections.abc import Callable

import numpy as np

from sim.deformation import Deformer
from sim.errors import InputError
from surrogate.evaluation.choose import ModelCandidate, ModelChoice, choose_model
from surrogate.model.guarded import Guarded
from surrogate.model.learned import Learned

from ..play.deformers import PatientSetup
from ..play.family_record import REMEDY
from ..play.player import Player
from ..script.scene import Scene
from .measurement import time_work

TIMED_FRAMES = 24  # Number of frames that are timed, after one that is not.
MAX_LIVE_ERROR = 5e-5  # Largest distance of a node from the converged solution at the accuracy LIVE [m].


def choose_within(
    patient: PatientSetup, scene: Scene, budget: tuple[float | None, float | None], notify: Callable[[str], object]
) -> ModelChoice:
    """Choose a deformation model of a scene within a `budget`: largest error [mm] and largest time per frame [ms].

    Candidates are the scene's deformers, timed on its frames, and the families with recorded figures. If a family is
    chosen by its recorded time, it is timed here, and the choice is repeated. `notify` receives sentences for users.

    Raises
    ------
    InputError
        See `choose` and `build_stage`.
    """
    stage, recorded, offers = patient.build_stage(scene), patient.select_recorded(scene), []
    if not recorded:
        notify(f"families of models are not offered: no figures for {scene.name} on this anatomy. {REMEDY}")

    def add_candidate(name: str, error_mm: float | None, remark: str) -> None:
        player = patient.build_player_of(stage, patient.build_deformer(name, scene), name)
        error_mm = 1e3 * _get_reported_error(player.deformer) if error_mm is None else error_mm
        if not np.isnan(error_mm):
            offers.append(ModelCandidate(name, error_mm, _time_frames(player), remark))

    for name in patient.list_deformers(scene):
        add_candidate(name, None, f"; error relative to {'converged ' * (name == 'fem')}FEM")
    of = {name: f"; error relative to p2 in 95 % of {one.loads} recorded pushes" for name, one in recorded.items()}
    waiting = {
        name: ModelCandidate(name, one.p95_mm, one.median_ms, f"{of[name]}; time of {one.machine.partition(',')[0]}")
        for name, one in recorded.items()
    }
    while (choice := choose_model([*offers, *waiting.values()], *budget)).candidate.name in waiting:
        name = choice.candidate.name
        notify(f"timing {waiting.pop(name)}, where its preparation took {recorded[name].preparation_s:.2g} s")
        try:
            add_candidate(name, recorded[name].p95_mm, of[name])
        except InputError as error:
            notify(f"{name} cannot be chosen: {error}")
    return choice


def _time_frames(player: Player) -> float:
    """Return the median time of a deformation [ms], over frames that are evenly spaced in the scene."""
    seconds, last = [], None
    for number in np.linspace(0, len(player.scene.times) - 1, TIMED_FRAMES + 1).astype(int).tolist():
        last, spent = time_work(player.compute_deformation, player.build_loads(number), last)
        seconds.append(spent)
    return 1e3 * float(np.median(seconds[1:]))


def _get_reported_error(deformer: Deformer) -> float:
    """Return the error [m] that a deformer reports; NaN if it reports no error."""
    if isinstance(deformer, Guarded):
        return float(np.fmin(deformer.model.bound, deformer.limit))
    return deformer.bound if isinstance(deformer, Learned) else MAX_LIVE_ERROR
