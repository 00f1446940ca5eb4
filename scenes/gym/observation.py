"""What a robot has of an episode: poses as tracked, forces as read, the plan's goal, and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from gymnasium import spaces

from ar.optics.camera import Camera
from ar.rendering.renderer import Renderer

from .setting import Setting
from .tasks import DEBULK, RETRACT, Goal, Task, find_task
from .tool_motion import Hand
from .touched import Touched

KINDS = ("states", "rgbd")
"""What observations may be."""
LENGTH = 0.01
"""What is 1 in an observation [m]."""
LONG = 10.0
"""What is 1 in an observation [s]: as long as an episode may last."""
TRACKED, FELT, SEEN = 1e-4, 2e-3, 2e-4
"""Standard deviations of a tracked place [m], a force's component [N], and a seen motion of the cortex [m]."""
BOUND = 10.0
"""No number of an observation is larger; what would be is cut off there."""
COUNT = 24
"""Numbers of a state."""
FARTHEST = 2.0
"""Depths of pictures are less [m]."""
# A tool goes down when it is so near over its place [m]; a force above this is contact [N]: three of its deviations.
OVER, TOUCHES = 1.5e-3, 6e-3
# Of the tissue under a tool [N/m].
STIFFNESS = 60.0
# A blade goes so many times as far as the cortex shall, and by so much farther in an episode: it does not see how far
# that is under it.
FOLLOWS, CREEPS = 1.0, 2.0
Seen = tuple[Touched, np.ndarray, int]
"""What is drawn: the tissue's answer, T_world_tool (4, 4), and how many steps of a resection are done."""


def twists() -> spaces.Box:
    """The space of actions: twists (6,) of a tool."""
    return spaces.Box(-1.0, 1.0, (6,), np.float32)


def space_of(kind: str, size: tuple[int, int]) -> spaces.Space:
    """The space of observations of one of `KINDS`, with pictures of a width and height [pixel]."""
    states = spaces.Box(-BOUND, BOUND, (COUNT,), np.float32)
    if kind == "states":
        return states
    width, height = size
    return spaces.Dict(
        {
            "rgb": spaces.Box(0, 255, (height, width, 3), np.uint8),
            "depth": spaces.Box(0.0, FARTHEST, (height, width), np.float32),
            "states": states,
        }
    )


def states(
    task: Task, goal: Goal, hand: Hand, sensed: np.ndarray, time: float, done: float, frame: np.ndarray,
    origin: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Numbers (24,) float32 of a state, in the frame (3, 3) of twists, from the open cortex's middle (3,) [m].

    Parameters
    ----------
    hand
        As it is tracked.
    sensed
        Force on the tissue [N] and motion of the open cortex [m] as they are read (2, 3).
    time
        Since the episode began [s].
    done
        Share of what is to be done that is kept up, or cut.
    """
    parts = (
        (hand.place - origin) @ frame / LENGTH,
        (frame.T @ hand.turned)[:, :2].T.ravel(),
        sensed[0] @ frame / task.force,
        [time / LONG],
        (goal.place - origin) @ frame / LENGTH,
        goal.direction @ frame,
        [goal.amount / task.unit],
        [done],
        sensed[1] @ frame / LENGTH,
    )
    return np.clip(np.concatenate(parts), -BOUND, BOUND).astype(np.float32)


def scripted(task: str, states: np.ndarray) -> np.ndarray:
    """Actions (..., 6) float32 for states (..., 24) of a task by name.

    Raises
    ------
    InputError
        There is no such task.
    """
    known = find_task(task)
    states = np.asarray(states, np.float64)
    place, goal, cortex = (LENGTH * states[..., first : first + 3] for first in (0, 13, 21))
    off = goal - place
    force = np.linalg.norm(known.force * states[..., 9:12], axis=-1)
    asked, touches = known.unit * states[..., 19], force > TOUCHES
    if known == DEBULK:
        off = off + cortex
        down = off[..., 2]
    elif known == RETRACT:
        direction = states[..., 16:19]
        beyond = (FOLLOWS + CREEPS * states[..., 12]) * asked - np.einsum("...i,...i->...", -off, direction)
        off = np.where(touches[..., None], beyond[..., None] * direction, off)
        down = np.where(touches, off[..., 2], -known.step)
    else:
        down = np.where(touches, -(asked - force) / STIFFNESS, -0.6 * known.step)
    near = np.linalg.norm(off[..., :2], axis=-1) < OVER
    waits = ~near if known != RETRACT else ~near & ~touches
    off[..., 2] = np.where(waits, 0.0, down)
    return _action(known, off)


def _action(task: Task, way: np.ndarray) -> np.ndarray:
    turn = np.zeros_like(way)
    return np.clip(np.concatenate([way / task.step, turn], axis=-1), -1.0, 1.0).astype(np.float32)


class Pictures:
    """Draws what the camera of a setting sees."""

    def __init__(self, setting: Setting):
        self.setting = setting
        self._renderers: dict[int, Renderer] = {}

    @cached_property
    def camera(self) -> Camera:
        """It stays where it is."""
        return self.setting.scene.viewpoint.camera(self.setting.site)

    def drawn(self, seen: Sequence[Seen]) -> tuple[np.ndarray, np.ndarray]:
        """Colours (B, H, W, 3) uint8 and depths (B, H, W) float32 [m], 0 where nothing is."""
        shape = len(seen), self.camera.height, self.camera.width
        colour, depth = np.empty((*shape, 3), np.uint8), np.empty(shape, np.float32)
        for done in sorted({each[2] for each in seen}):
            rows = [row for row, each in enumerate(seen) if each[2] == done]
            stage = self.setting.after(done)
            scenes = [stage.layers(self._positions(touched), pose) for touched, pose, _ in (seen[row] for row in rows)]
            if done not in self._renderers:
                self._renderers[done] = Renderer(scenes[0], stage.lamp, stage.device)
            moved = [np.concatenate([each.vertices for each in layers if not each.still]) for layers in scenes]
            pictures = self._renderers[done].pictures(np.stack(moved), [self.camera])
            colour[rows], depth[rows] = pictures.colour.numpy(), pictures.depth.numpy()
        return colour, depth

    def _positions(self, touched: Touched) -> np.ndarray:
        positions = self.setting.site.anatomy.mesh.nodes.copy()
        positions[touched.nodes] += touched.motion
        return positions
