"""Deformers of a scene on a page: trained models, and FEM solvers in their own threads."""

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
from .comparison import AccuracyTimeTable, compute_node_errors
from .fem_worker import FemResult, FemWorker, FrameRequest
from .requests import Display

ALL_ACTIVE: frozenset[str] = frozenset()
"""Empty set of disabled effects: all effects are active."""


class SceneSolvers:
    """Stages, trained models and FEM solvers of one scene, with all effects or with some effects disabled.

    `playable` is True if a trained model was requested or an FEM solver is ready.
    """

    def __init__(self, patient: PatientSetup, scene: Scene, deformer: str, build_lock: threading.Lock) -> None:
        """Start with the deformer named `deformer`. FEM solvers are built one at a time, under `build_lock`.

        Raises
        ------
        InputError
            The deformer does not support the scene.
        """
        self.patient, self.build_lock = patient, build_lock
        # Not on a GPU: rendering while a solver's thread records a CUDA graph would be recorded, too.
        self.stages = {ALL_ACTIVE: replace(patient.build_stage(scene), device="cpu")}
        self.players: dict[tuple[str, frozenset[str]], Player] = {}
        self.camera_stages: dict[tuple, Stage] = {}
        self.last: dict[str, Deformation] = {}
        self.sessions: dict[str, ReplaySession] = {}
        self.solvers: dict[frozenset[str], FemWorker] = {}
        # FEM worker that computes the next displayed solution, and its request.
        self.pending: tuple[FemWorker, FrameRequest] | None = None
        self.playable = deformer != "fem"
        if self.playable:
            self.get_player(deformer)

    def get_stage(self, disabled_effects: frozenset[str] = ALL_ACTIVE) -> Stage:
        """Return the stage of the scene without the disabled effects, with unchanged tissue."""
        if disabled_effects not in self.stages:
            scene = self.stages[ALL_ACTIVE].scene
            for effect in scene.get_effects_on(self.patient.anatomy):
                scene = remove_effect(scene, effect) if type(effect).__name__ in disabled_effects else scene
            self.stages[disabled_effects] = replace(self.stages[ALL_ACTIVE], scene=scene)
        return self.stages[disabled_effects]

    def get_worker(self, disabled_effects: frozenset[str] = ALL_ACTIVE) -> FemWorker:
        """Return the FEM worker of the scene without the disabled effects; start the worker if it does not exist."""
        if disabled_effects not in self.solvers:
            scene = self.get_stage(disabled_effects).scene
            self.solvers[disabled_effects] = FemWorker(self.patient, scene, self.build_lock)
        return self.solvers[disabled_effects]

    def get_player(self, name: str, disabled_effects: frozenset[str] = ALL_ACTIVE) -> Player:
        """Return the player `name` of the scene without the disabled effects; FEM must have its solver already."""
        if (name, disabled_effects) not in self.players:
            stage = self.get_stage(disabled_effects)
            if name == "fem":
                fem_player = self.get_worker(disabled_effects).player
                assert fem_player is not None
                deformer = fem_player.deformer
            else:
                deformer = self._build_trained_model(name, stage.scene)
            self.players[name, disabled_effects] = self.patient.build_player_of(stage, deformer, name)
        return self.players[name, disabled_effects]

    def get_player_with_camera(self, deformer: str, disabled_effects: frozenset[str], display: Display) -> Player:
        """Return the player `deformer` with the camera and the registration of the display settings."""
        player = self.get_player(deformer, disabled_effects)
        key = disabled_effects, display.path, display.tilt, display.distance, display.registration
        if key[1:] == ("", None, None, None):
            return player
        if key not in self.camera_stages:
            scene = player.scene
            viewpoint = scene.viewpoint
            if display.path:
                viewpoint = replace(viewpoint, path=PATHS[display.path](0) if display.path in PATHS else None)
            if display.tilt is not None:
                viewpoint = replace(viewpoint, tilt=display.tilt)
            if display.distance is not None:
                viewpoint = replace(viewpoint, distance=display.distance)
            scene = replace(scene, viewpoint=viewpoint, registration=display.registration or scene.registration)
            # Only the newest stage is kept: a moving slider requests many.
            self.camera_stages = {key: replace(player.stage, scene=scene)}
        return replace(player, stage=self.camera_stages[key])

    def _build_trained_model(self, name: str, scene: Scene) -> Deformer:
        """Return the trained model `name`. An FEM fallback is built under `build_lock`, on the CPU like the stages."""
        with self.build_lock if name == GUARDED else nullcontext():
            return replace(self.patient, device="cpu").build_deformer(name, scene)

    def predict(self, model_name: str, request: FrameRequest) -> FemResult:
        """Compute a trained model's solution of a request; an FEM fallback starts from the model's last solution.

        A model that integrates relaxing tissue in time computes the previous frames first.
        """
        start, player = clock.perf_counter(), self.get_player(model_name)
        if player.follows:
            session = self.sessions.setdefault(model_name, ReplaySession(player))
            number, deformation = session.approach_frame(*request)
            while number != request[0]:
                number, deformation = session.approach_frame(*request)
            return FemResult(number, player.build_loads(*request), deformation, clock.perf_counter() - start, request)
        loads = player.build_loads(*request)
        deformation = self.last[model_name] = player.compute_deformation(loads, self.last.get(model_name))
        return FemResult(request[0], loads, deformation, clock.perf_counter() - start, request)

    def compare_models(self, reference: FemResult, costs: AccuracyTimeTable, excluded_model: str) -> None:
        """Record in `costs` times and errors of FEM and the models except `excluded_model`, for `reference`'s load."""
        digest, scene = compute_loads_digest(reference.loads), self.get_stage().scene
        costs.record_time("fem", digest, reference.deformation.cost.total)
        costs.record_error("fem", digest, 0.0)
        for name in self.patient.select_models(scene):
            player = self.get_player(name)
            if name != excluded_model and not player.follows:
                solution = player.compute_deformation(reference.loads)
                costs.record_time(name, digest, solution.cost.total)
                costs.record_error(name, digest, float(compute_node_errors(reference, player, solution).mean()))

    def solve(
        self, disabled_effects: frozenset[str], request: FrameRequest, previous: FemResult | None, timeout: float
    ) -> FemResult | None:
        """Return the FEM solution of the requested frame or of a frame in between; start the worker if necessary.

        Parameters
        ----------
        previous
            Solution that the page already has; another solution is returned.
        timeout
            Maximum waiting time [s], after which None is returned.

        Raises
        ------
        Exception
            Any exception of the solver's thread.
        """
        worker = self.get_worker(disabled_effects)
        if self.pending != (worker, request):
            self._replace_pending(worker, request)
        if worker.failure is not None and (worker.refused == request or not worker.thread.is_alive()):
            self.pending = None
            if not worker.thread.is_alive():
                del self.solvers[disabled_effects]
            raise worker.failure
        result = worker.wait_for_result(request, previous, timeout)
        self.playable = self.playable or worker.player is not None
        return result

    def _replace_pending(self, worker: FemWorker, request: FrameRequest) -> None:
        """Send the request for the next displayed solution to `worker`, and drop the request of another worker."""
        if self.pending is not None and self.pending[0] is not worker:
            self.pending[0].drop_request()
        self.pending = worker, request
        worker.request_frame(*request)

    def stop_all(self) -> None:
        """Withdraw the pending request; its worker stops after the current step."""
        if self.pending is not None:
            self.pending[0].drop_request()
            self.pending = None

    def stop_soon(self) -> list[FemWorker]:
        """Stop the FEM workers without waiting for their current solves; return the workers that are still running."""
        for worker in self.solvers.values():
            worker.stop_soon()
        return [worker for worker in self.solvers.values() if worker.thread.is_alive()]
