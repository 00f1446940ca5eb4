"""Gymnasium environments of the tasks: a single and a vectorised environment."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from sim.arguments import check_integer
from sim.errors import InputError

from .episode import Episode, EpisodeStep
from .observation import KINDS, build_action_space, build_observation_space
from .observation_camera import ObservationCamera
from .registration import MAX_STEPS
from .setting import TaskSetting, check_arguments, open_setting
from .tasks import STEP_SECONDS, find_task
from .tissue_requests import TissueRequest

RENDER_MODES = ("rgb_array",)  # Supported render modes.
METADATA: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": round(1.0 / STEP_SECONDS)}
"""Metadata that Gymnasium requires: render modes and frame rate."""


def open_environment_setting(
    task: str, observation: str, render_mode: str | None, settings: Mapping[str, Any], is_batched: bool | None = None
) -> TaskSetting:
    """Open the shared setting of environments; `settings` contains the arguments `ARGUMENTS` of `open_setting`.

    Raises
    ------
    InputError
        See `open_setting`; also if the task, the observation or the render mode is unknown.
    """
    if observation not in KINDS:
        raise InputError(f"observation is {observation!r:.80}: choose one of {', '.join(KINDS)}.")
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise InputError(f"render_mode is {render_mode!r:.80}: choose {', '.join(RENDER_MODES)}, or None.")
    return open_setting(find_task(task), *check_arguments(settings), is_batched)


class SurgeryEnv(gymnasium.Env):
    """Single environment: `gymnasium.make("sulcus/Palpate-v0")`.

    Parameters
    ----------
    task
        "palpate", "retract" or "debulk".
    anatomy, physics, device, size, model
        See `open_setting`.
    observation
        "states", or "rgbd" (states and images).
    render_mode
        "rgb_array", or None.

    Raises
    ------
    InputError
        See `open_environment_setting`.
    """

    metadata = METADATA

    def __init__(
        self,
        task: str = "palpate",
        anatomy: str | Path = "template",
        observation: str = "states",
        physics: str = "auto",
        device: str = "auto",
        size: tuple[int, int] = (160, 120),
        render_mode: str | None = None,
        model: str | Path | None = None,
    ):
        given = {"anatomy": anatomy, "physics": physics, "device": device, "size": size, "model": model}
        self.setting = open_environment_setting(task, observation, render_mode, given)
        self.observation, self.render_mode = observation, render_mode
        self.observation_space = build_observation_space(observation, size)
        self.action_space = build_action_space()
        self.episode, self.pictures = Episode(self.setting), ObservationCamera(self.setting)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; return observation and ground truth. There are no `options`.

        Raises
        ------
        InputError
            `options` are given.
        """
        super().reset(seed=seed)
        if options:
            raise InputError(f"options are {options!r:.80}: there are none; give them to gymnasium.make.")
        (touched,) = self.setting.tissue_model.compute_responses([self.episode.begin(self.np_random)])
        step = self.episode.end_step(touched)
        return self._build_observation(step), step.info

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Move the tool; return observation, reward, True at a goal or limit, False (never truncated), ground truth.

        Raises
        ------
        InputError
            See `Episode.request_step`.
        """
        (touched,) = self.setting.tissue_model.compute_responses([self.episode.request_step(action)])
        step = self.episode.end_step(touched)
        return self._build_observation(step), step.reward, step.terminated, False, step.info

    def render(self) -> np.ndarray | None:
        """Return the camera image (H, W, 3) uint8; None without a render mode.

        Raises
        ------
        InputError
            No episode has begun.
        """
        return None if self.render_mode is None else self.pictures.render([self.episode.view])[0][0]

    def _build_observation(self, step: EpisodeStep) -> Any:
        if self.observation == "states":
            return step.states
        colour, depth = self.pictures.render([self.episode.view])
        return {"rgb": colour[0], "depth": depth[0], "states": step.states}


class SurgeryVectorEnv(VectorEnv):
    """Vectorised environments: `gymnasium.make_vec("sulcus/Palpate-v0", num_envs=64)`.

    The first step after the end of an episode ignores the action, begins an episode, and has the reward 0.

    Parameters
    ----------
    num_envs
        Number of environments.
    max_episode_steps
        Number of steps after which an episode is truncated.
    task, anatomy, observation, physics, device, size, render_mode
        See `SurgeryEnv`.
    together
        See `open_setting`.

    Raises
    ------
    InputError
        See `SurgeryEnv`; also if the number of environments or of steps is < 1.
    """

    metadata = METADATA | {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int = MAX_STEPS,
        task: str = "palpate",
        anatomy: str | Path = "template",
        observation: str = "states",
        physics: str = "auto",
        device: str = "auto",
        size: tuple[int, int] = (160, 120),
        render_mode: str | None = None,
        model: str | Path | None = None,
        together: bool | None = None,
    ):
        self.num_envs = check_integer("num_envs", num_envs, 1)
        self.steps = check_integer("max_episode_steps", max_episode_steps, 1)
        given = {"anatomy": anatomy, "physics": physics, "device": device, "size": size, "model": model}
        self.setting = open_environment_setting(task, observation, render_mode, given, together)
        self.observation, self.render_mode = observation, render_mode
        self.single_observation_space = build_observation_space(observation, size)
        self.single_action_space = build_action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.episodes = [Episode(self.setting) for _ in range(num_envs)]
        self.pictures = ObservationCamera(self.setting)
        self.randoms = [np.random.default_rng() for _ in range(num_envs)]

    def reset(
        self, *, seed: int | np.integer | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin the episodes of all environments; for a single seed s, environment i has the seed s + i.

        Raises
        ------
        InputError
            `options` are given, or the number of seeds is not the number of environments.
        """
        if options:
            raise InputError(f"options are {options!r:.80}: there are none; give them to gymnasium.make_vec.")
        seeds = [int(seed) + row for row in range(self.num_envs)] if isinstance(seed, int | np.integer) else seed
        seeds = [None] * self.num_envs if seeds is None else list(seeds)
        if len(seeds) != self.num_envs:
            raise InputError(f"{len(seeds)} seeds for {self.num_envs} environments: give one for each, or one for all.")
        for row, each in enumerate(seeds):
            if each is not None or self.episodes[row].drawn is None:
                self.randoms[row] = seeding.np_random(each)[0]
        steps = self._take_steps([episode.begin(self.randoms[row]) for row, episode in enumerate(self.episodes)])
        return self._build_observation(steps), self._stack_infos(steps)

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Move the tools of all environments; return the results of `SurgeryEnv.step` with a row per environment.

        Raises
        ------
        InputError
            Actions do not have the shape (num_envs, 6) or are not finite, or `reset` was not called.
        """
        twists = np.array(actions, np.float64)
        if twists.shape != (self.num_envs, 6):
            raise InputError(f"the actions have the shape {twists.shape}: give ({self.num_envs}, 6).")
        begins = [episode.over and episode.drawn is not None for episode in self.episodes]
        steps = self._take_steps(
            [
                episode.begin(self.randoms[row]) if begins[row] else episode.request_step(twists[row])
                for row, episode in enumerate(self.episodes)
            ]
        )
        terminated = np.array([step.terminated for step in steps])
        truncated = np.array([episode.step >= self.steps for episode in self.episodes])
        for episode, late in zip(self.episodes, truncated.tolist(), strict=True):
            episode.over = episode.over or late
        rewards = np.array([step.reward for step in steps])
        return self._build_observation(steps), rewards, terminated, truncated, self._stack_infos(steps)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return the camera image (H, W, 3) uint8 of each environment; None without a render mode."""
        if self.render_mode is None:
            return None
        return tuple(self.pictures.render([episode.view for episode in self.episodes])[0])

    def _take_steps(self, requests: list[TissueRequest]) -> list[EpisodeStep]:
        answers = self.setting.tissue_model.compute_responses(requests)
        return [episode.end_step(touched) for episode, touched in zip(self.episodes, answers, strict=True)]

    def _build_observation(self, steps: Sequence[EpisodeStep]) -> Any:
        states = np.stack([step.states for step in steps])
        if self.observation == "states":
            return states
        colour, depth = self.pictures.render([episode.view for episode in self.episodes])
        return {"rgb": colour, "depth": depth, "states": states}

    def _stack_infos(self, steps: Sequence[EpisodeStep]) -> dict[str, Any]:
        """Return the ground truth as arrays with a row per environment, and Gymnasium's masks, which are all True."""
        infos = {name: np.stack([step.info[name] for step in steps]) for name in steps[0].info}
        return infos | {f"_{name}": np.ones(self.num_envs, bool) for name in infos}
