"""Deformers of a scene on a page: trained models, and FEM, which runs in its own threads."""

import threading
import time as clock
from contextlib import nullcontext
from dataclasses import replace

from sim.deformation import Deformation, Deformer
from surrogate.data.dataset import compute_loads_digest

from ..play.deformers import GUARDED, PatientSetup
from ..play.effect_ablation import remove_effect
from ..play.player import Player
from ..play.replay import ReplaySession
from ..play.stage import Stage
from ..script.camera_paths import PATHS
from ..script.scene import Scene
from .comparison import AccuracyTimeTable, compute_distances
from .fem_worker import FemResult, FemWorker, Question
from .requests import Look

ALL_ACTIVE: frozenset[str] = frozenset()
"""Disabled effects when all effects are active."""


class SceneSolvers:
    """Stages, models and FEM solvers of one scene, with all its effects or without some.

    `playable` is true if one of them is ready to compute.
    """

    def __init__(self, theatre: PatientSetup, scene: Scene, deformer: str, turn: threading.Lock) -> None:
        """Start with the `deformer` of that name. FEM solvers are built one at a time, under the lock `turn`.

        Raises
        ------
        InputError
            A deformer that does not support the scene.
        """
        self.theatre, self.turn = theatre, turn
        # Not on a GPU: rendering while a solver's thread records a CUDA graph would be recorded, too.
        self.stages = {ALL_ACTIVE: replace(theatre.build_stage(scene), device="cpu")}
        self.players: dict[tuple[str, frozenset[str]], Player] = {}
        self.filmed: dict[tuple, Stage] = {}
        self.last: dict[str, Deformation] = {}
        self.sessions: dict[str, ReplaySession] = {}
        self.solvers: dict[frozenset[str], FemWorker] = {}
        # FEM worker that computes the next displayed solution, and its request.
        self.seeking: tuple[FemWorker, Question] | None = None
        self.playable = deformer != "fem"
        if self.playable:
            self.get_player(deformer)

    def get_stage(self, off: frozenset[str] = ALL_ACTIVE) -> Stage:
        """Return the stage of the scene without some effects, of the tissue that it has with them."""
        if off not in self.stages:
            scene = self.stages[ALL_ACTIVE].scene
            for effect in scene.get_effects_on(self.theatre.anatomy):
                scene = remove_effect(scene, effect) if type(effect).__name__ in off else scene
            self.stages[off] = replace(self.stages[ALL_ACTIVE], scene=scene)
        return self.stages[off]

    def get_worker(self, off: frozenset[str] = ALL_ACTIVE) -> FemWorker:
        """Return the finite elements of the scene without some effects."""
        if off not in self.solvers:
            self.solvers[off] = FemWorker(self.theatre, self.get_stage(off).scene, self.turn)
        return self.solvers[off]

    def get_player(self, name: str, off: frozenset[str] = ALL_ACTIVE) -> Player:
        """Return the player of the scene without some effects: a trained model, or FEM with a solution."""
        if (name, off) not in self.players:
            stage = self.get_stage(off)
            if name == "fem":
                solved = self.get_worker(off).player
                assert solved is not None
                deformer = solved.deformer
            else:
                deformer = self._build_trained(name, stage.scene)
            self.players[name, off] = self.theatre.build_player_of(stage, deformer)
        return self.players[name, off]

    def get_player_with_camera(self, name: str, off: frozenset[str], look: Look) -> Player:
        """Return the same, with the camera and the registration of a display style."""
        player, key = self.get_player(name, off), (off, look.path, look.tilt, look.distance, look.registration)
        if key[1:] == ("", None, None, None):
            return player
        if key not in self.filmed:
            scene = player.scene
            view = scene.viewpoint
            if look.path:
                view = replace(view, path=PATHS[look.path](0) if look.path in PATHS else None)
            if look.tilt is not None:
                view = replace(view, tilt=look.tilt)
            if look.distance is not None:
                view = replace(view, distance=look.distance)
            scene = replace(scene, viewpoint=view, registration=look.registration or scene.registration)
            # Only the newest is kept: a slider passes through many.
            self.filmed = {key: replace(player.stage, scene=scene)}
        return replace(player, stage=self.filmed[key])

    def _build_trained(self, name: str, scene: Scene) -> Deformer:
        """Return a trained model. Its FEM fallback is built under `turn`, on the CPU like the stages."""
        with self.turn if name == GUARDED else nullcontext():
            return replace(self.theatre, device="cpu").build_deformer(name, scene)

    def predict(self, name: str, question: Question) -> FemResult:
        """Compute a trained model's solution; its FEM fallback starts from the last one.

        A model that integrates its tissue in time computes the previous frames first.
        """
        begun, player = clock.perf_counter(), self.get_player(name)
        if player.follows:
            session = self.sessions.setdefault(name, ReplaySession(player))
            number, answer = session.approach_frame(*question)
            while number != question[0]:
                number, answer = session.approach_frame(*question)
            return FemResult(number, player.build_loads(*question), answer, clock.perf_counter() - begun, question)
        loads = player.build_loads(*question)
        answer = self.last[name] = player.compute_deformation(loads, self.last.get(name))
        return FemResult(question[0], loads, answer, clock.perf_counter() - begun, question)

    def compare_models(self, truth: FemResult, tally: AccuracyTimeTable, skip: str) -> None:
        """Record time and error of FEM and of each trained model but `skip`, for the load of an FEM solution."""
        load, scene = compute_loads_digest(truth.loads), self.get_stage().scene
        tally.record_time("fem", load, truth.deformation.cost.total)
        tally.record_error("fem", load, 0.0)
        for name in self.theatre.select_models(scene):
            player = self.get_player(name)
            if name != skip and not player.follows:
                shown = player.compute_deformation(truth.loads)
                tally.record_time(name, load, shown.cost.total)
                tally.record_error(name, load, float(compute_distances(truth, player, shown).mean()))

    def solve(
        self, off: frozenset[str], question: Question, seen: FemResult | None, patience: float
    ) -> FemResult | None:
        """Return the FEM solution of a frame, or of one on the way to it. The solver is started if necessary.

        Parameters
        ----------
        seen
            Solution that is already available.
        patience
            Maximum time to wait for another [s]; None is returned after it.

        Raises
        ------
        Exception
            Any exception of the solver's thread.
        """
        solver = self.get_worker(off)
        if self.seeking != (solver, question):
            self._seek(solver, question)
        if solver.failure is not None and (solver.refused == question or not solver.thread.is_alive()):
            self.seeking = None
            if not solver.thread.is_alive():
                del self.solvers[off]
            raise solver.failure
        truth = solver.wait_newer(question, seen, patience)
        self.playable = self.playable or solver.player is not None
        return truth

    def _seek(self, solver: FemWorker, question: Question) -> None:
        """Request the next displayed solution, and drop the previous request."""
        if self.seeking is not None and self.seeking[0] is not solver:
            self.seeking[0].drop()
        self.seeking = solver, question
        solver.ask(*question)

    def stop_all(self) -> None:
        """Nothing more is wanted: what is under way ends with the step in hand."""
        if self.seeking is not None:
            self.seeking[0].drop()
            self.seeking = None

    def stop_soon(self) -> list[FemWorker]:
        """Stop the finite elements, without waiting for the steps in hand; returns those that have one."""
        for solver in self.solvers.values():
            solver.stop_soon()
        return [solver for solver in self.solvers.values() if solver.thread.is_alive()]
