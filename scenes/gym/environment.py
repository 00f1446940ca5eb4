"""A task as a `gymnasium.Env`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from sim.errors import InputError

from .episode import Episode, Step
from .observation import KINDS, space_of, twists
from .pictures import Pictures
from .setting import Setting, checked, open_setting
from .tasks import SECONDS, find_task

RENDERED = ("rgb_array",)
METADATA: dict[str, Any] = {"render_modes": list(RENDERED), "render_fps": round(1.0 / SECONDS)}
"""What Gymnasium asks of every environment."""


def opened(
    task: str, observation: str, render_mode: str | None, given: Mapping[str, Any], together: bool | None = None
) -> Setting:
    """Open the setting of environments; anatomy, physics, device, size and model are `given` as to `open_setting`.

    Raises
    ------
    InputError
        As `open_setting`; an unknown task, observation or render mode.
    """
    if observation not in KINDS:
        raise InputError(f"observation is {observation!r:.80}: choose one of {', '.join(KINDS)}.")
    if render_mode is not None and render_mode not in RENDERED:
        raise InputError(f"render_mode is {render_mode!r:.80}: choose {', '.join(RENDERED)}, or None.")
    return open_setting(find_task(task), *checked(given), together)


class Operation(gymnasium.Env):
    """One environment: `gymnasium.make("sulcus/Palpate-v0")`.

    Parameters
    ----------
    task
        "palpate", "retract" or "debulk".
    anatomy, physics, device, size, model
        As `open_setting`.
    observation
        "states", or "rgbd": pictures too.
    render_mode
        "rgb_array", or None.

    Raises
    ------
    InputError
        As `opened`.
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
        self.setting = opened(task, observation, render_mode, given)
        self.observation, self.render_mode = observation, render_mode
        self.observation_space = space_of(observation, size)
        self.action_space = twists()
        self.episode, self.pictures = Episode(self.setting), Pictures(self.setting)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode: what is seen, and the truth; `options` are none.

        Raises
        ------
        InputError
            Options.
        """
        super().reset(seed=seed)
        if options:
            raise InputError(f"options are {options!r:.80}: there are none; give them to gymnasium.make.")
        (touched,) = self.setting.answers.answer([self.episode.begin(self.np_random)])
        step = self.episode.take(touched)
        return self._observed(step), step.info

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Move the tool: what is seen, the reward, whether the goal or a limit was reached, False, and the truth.

        Raises
        ------
        InputError
            As `Episode.ask`.
        """
        (touched,) = self.setting.answers.answer([self.episode.ask(action)])
        step = self.episode.take(touched)
        return self._observed(step), step.reward, step.terminated, False, step.info

    def render(self) -> np.ndarray | None:
        """What the camera sees (H, W, 3) uint8; None without a render mode.

        Raises
        ------
        InputError
            No episode has begun.
        """
        return None if self.render_mode is None else self.pictures.drawn([self.episode.seen])[0][0]

    def _observed(self, step: Step) -> Any:
        if self.observation == "states":
            return step.states
        colour, depth = self.pictures.drawn([self.episode.seen])
        return {"rgb": colour[0], "depth": depth[0], "states": step.states}
