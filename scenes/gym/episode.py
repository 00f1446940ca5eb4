"""Episodes of one environment: goal, tool motion, score and reward."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sim.errors import InputError

from ..script.camera_paths import sample_hand_motion
from ..script.tool_paths import smooth_step
from .observation import FORCE_NOISE, MOTION_NOISE, POSITION_NOISE, compute_states
from .observation_camera import Seen
from .setting import TaskSetting
from .tasks import MAX_LOAD_RATIO, STEP_SECONDS, Goal
from .tissue_requests import Response, TissueRequest
from .tool_motion import RobotTool, build_tool_frame, compute_pivot_distance, move_tool, place_tool, shift_pose


@dataclass(frozen=True)
class RewardSettings:
    """Settings of `compute_reward`."""

    step_penalty: float = 0.01  # Penalty of a step.
    limit_penalty: float = 0.5  # Penalty of a step with a load over its limit.
    success_reward: float = 10.0  # Reward of success.
    abort_reward: float = -10.0  # Reward of the end of an episode at a limit.
    share_reward: float = 3.0  # Reward of each share of the tumour that is resected.
    max_potential_distance: float = 0.03  # Distance beyond which the potential no longer falls [m].
    potential_length: float = 0.01  # Distance that lowers the potential by 1 [m].


REWARD = RewardSettings()
MAX_TREMOR = 1e-4  # Largest standard deviation of the tremor [m].
START_HEIGHTS = (5e-3, 8e-3)  # Range of the initial height of a tool above the cortex [m].
START_OFFSETS = (3e-3, 8e-3)  # Range of the initial lateral distance of a tool from its goal [m].
DRAIN_STEPS = 60  # Number of steps in which the fluid level falls.


@dataclass(frozen=True)
class EpisodeScore:
    """Score of a state of an episode: distances from the goal, and load.

    Parameters
    ----------
    distance
        Distance of the tool from its target position [m].
    amount_error
        Difference between reached and requested amount, relative to the requested amount.
    cut_shares
        Number of resected parts of the tumour.
    load_ratio
        Maximum of force and pressure, each relative to its limit.
    """

    distance: float
    amount_error: float
    cut_shares: int
    load_ratio: float

    @property
    def potential(self) -> float:
        """Potential of the state; its increase in a step is a part of the reward."""
        away = min(self.distance, REWARD.max_potential_distance) / REWARD.potential_length
        return REWARD.share_reward * self.cut_shares - away - min(self.amount_error, 1.0)


def compute_reward(previous: EpisodeScore, current_score: EpisodeScore, is_success: bool, is_aborted: bool) -> float:
    """Return the reward of a step from the scores before and after it; `is_aborted`: the episode ends at a limit."""
    reward = current_score.potential - previous.potential - REWARD.step_penalty
    if current_score.load_ratio > 1.0:
        reward -= REWARD.limit_penalty
    return float(reward + (REWARD.success_reward if is_success else REWARD.abort_reward if is_aborted else 0.0))


@dataclass(frozen=True, eq=False)
class EpisodeStep:
    """Result of a step: state (24,), reward, True at the end of the episode, and ground truth by name."""

    states: np.ndarray
    reward: float
    terminated: bool
    info: dict[str, Any]


@dataclass(frozen=True, eq=False)
class ResetSample:
    """Random values of an episode: goal, initial pose of the tool, seed and standard deviation [m] of the tremor."""

    goal: Goal
    hand: RobotTool
    seed: int
    tremor: float


def sample_reset(setting: TaskSetting, random: np.random.Generator) -> ResetSample:
    """Sample the random values of an episode."""
    goal, site, tool = setting.sample_goal(random), setting.site, setting.task.tool
    high, far, angle, size = random.random(4)
    aside = START_OFFSETS[0] + far * (START_OFFSETS[1] - START_OFFSETS[0])
    x, y = ((goal.position - site.origin) @ axis for axis in (site.right, site.up))
    x, y = x + aside * np.cos(2.0 * np.pi * angle), y + aside * np.sin(2.0 * np.pi * angle)
    under = site.find_contact(float(x), float(y), tool.radius).point
    tip = under - (START_HEIGHTS[0] + high * (START_HEIGHTS[1] - START_HEIGHTS[0])) * site.axis
    return ResetSample(goal, place_tool(site, tool, tip), int(random.integers(2**31)), MAX_TREMOR * float(size))


class Episode:
    """Successive episodes of an environment. Call `begin` or `request_step`, and then `end_step` with the response.

    Parameters
    ----------
    setting
        Task on a body.
    """

    def __init__(self, setting: TaskSetting):
        self.setting = setting
        self.frame = build_tool_frame(setting.site)
        self.drawn: ResetSample | None = None
        self.over = True

    def begin(self, random: np.random.Generator) -> TissueRequest:
        """Sample a new episode, and return its first request to the tissue model."""
        self.random, self.drawn = random, sample_reset(self.setting, random)
        self.hand, self.touched, self.judged = self.drawn.hand, None, None
        self.step, self.held, self.violations, self.cut, self.over = 0, 0, 0, 0, False
        self.patch = self.setting.find_vertices_near(self.drawn.goal.position)
        return self._build_request(self.drawn)

    def request_step(self, action: np.ndarray) -> TissueRequest:
        """Move the tool by an action (6,), and return the next request to the tissue model.

        Raises
        ------
        InputError
            The action is not six finite numbers, or the episode is over or has not begun.
        """
        if self.over or self.drawn is None:
            raise InputError("this episode is over, or did not begin: call reset().")
        twist = np.array(action, np.float64)
        if twist.shape != (6,) or not np.isfinite(twist).all():
            raise InputError(f"the action {np.array2string(twist, threshold=12)} is none: give six finite numbers.")
        task = self.setting.task
        twist = np.clip(twist, -1.0, 1.0) * np.repeat([task.step, task.turn], 3)
        self.hand = move_tool(self.hand, self.setting.site, task.tool, twist, task.max_tilt, task.max_depth)
        self.step += 1
        return self._build_request(self.drawn)

    def _build_request(self, sample: ResetSample) -> TissueRequest:
        task = self.setting.task
        offset = sample.tremor * self.frame @ sample_hand_motion(sample.seed, STEP_SECONDS * self.step)[:3]
        self.actual = shift_pose(self.hand, offset)
        fluid = 1.0 - (1.0 - sample.goal.fluid) * smooth_step(self.step / DRAIN_STEPS)
        return TissueRequest(self.actual.compute_pose(task.tool), self.touched, fluid, self.completed_steps)

    @property
    def completed_steps(self) -> int:
        """Number of completed resection steps; the corridor is already resected when an episode begins."""
        return self.cut + 1 if self.setting.task.resects else 0

    @property
    def view(self) -> Seen:
        """State of the episode for rendering.

        Raises
        ------
        InputError
            No episode has begun.
        """
        if self.touched is None:
            raise InputError("no episode has begun: call reset() before render().")
        return self.touched, self.actual.compute_pose(self.setting.task.tool), self.shown

    def end_step(self, response: Response) -> EpisodeStep:
        """Complete a step with the response of the tissue model, and return the result."""
        assert self.drawn is not None
        task, goal, self.shown = self.setting.task, self.drawn.goal, self.completed_steps
        target = self._compute_target(response)
        judged = self._compute_score(response, target)
        kept = response.reliable and judged.distance <= task.max_distance and judged.load_ratio <= 1.0
        kept = kept and judged.amount_error <= task.tolerance
        self.held = self.held + 1 if kept else 0
        success = self.held >= task.hold_steps
        if success and task.resects:
            self.cut, self.held = self.cut + 1, 0
            success = self.cut >= goal.amount
            judged = self._compute_score(response, target)
        ended = judged.load_ratio > MAX_LOAD_RATIO or not response.reliable
        reward = 0.0 if self.judged is None else compute_reward(self.judged, judged, success, ended)
        self.violations += int(judged.load_ratio > 1.0)
        self.touched, self.judged, self.over = response, judged, success or ended
        return EpisodeStep(
            self._build_states(response), reward, success or ended, self._collect_truth(response, target, success)
        )

    def _compute_target(self, response: Response) -> np.ndarray:
        """Compute the target (3,) [m] of the tool: the goal, or the deformed position of the next part to resect."""
        planned = self._compute_planned_target()
        return planned if self.next_share is None else planned + response.motion[self.next_share].mean(axis=0)

    @property
    def next_share(self) -> np.ndarray | None:
        """Vertices of the next part of the tumour to resect, or of the last part; None if the task resects nothing."""
        shares = self.setting.resection_shares
        return shares[min(self.cut, len(shares) - 1)] if shares else None

    def _compute_planned_target(self) -> np.ndarray:
        """Compute the target position (3,) [m] of the tool in the undeformed scan."""
        assert self.drawn is not None
        nodes = self.setting.site.anatomy.mesh.nodes
        return self.drawn.goal.position if self.next_share is None else nodes[self.next_share].mean(axis=0)

    def _compute_score(self, response: Response, target: np.ndarray) -> EpisodeScore:
        assert self.drawn is not None
        task, goal, axis = self.setting.task, self.drawn.goal, self.setting.site.axis
        size = float(np.linalg.norm(response.force))
        load = max(size / task.max_force, response.pressure / task.max_pressure)
        if task.resects:
            return EpisodeScore(float(np.linalg.norm(self.actual.position - target)), 0.0, self.cut, load)
        tip = self.actual.position + compute_pivot_distance(task.tool) * axis
        along = float((target - tip) @ axis)
        aside = float(np.linalg.norm(target - tip - along * axis))
        away = float(np.hypot(aside, max(along, 0.0) if size == 0.0 else 0.0))
        return EpisodeScore(away, abs(self._compute_reached(response) - goal.amount) / goal.amount, 0, load)

    def _compute_reached(self, response: Response) -> float:
        """Return the reached amount, which the goal prescribes: force [N], shift [m], or number of resected parts."""
        assert self.drawn is not None
        if self.setting.task.resects:
            return float(self.cut)
        if self.setting.task.max_push_angle == 0.0:
            return float(np.linalg.norm(response.force))
        row = np.searchsorted(response.nodes, self.patch)
        return float(response.motion[row].mean(axis=0) @ self.drawn.goal.direction)

    def _build_states(self, response: Response) -> np.ndarray:
        assert self.drawn is not None
        task, goal = self.setting.task, self.drawn.goal
        cortex = response.motion[np.searchsorted(response.nodes, self.setting.cortex)].mean(axis=0)
        noise = self.random.standard_normal((3, 3))
        tracked = shift_pose(self.actual, POSITION_NOISE * noise[0])
        sensed = np.stack([response.force, cortex]) + np.array([[FORCE_NOISE], [MOTION_NOISE]]) * noise[1:]
        done = self.cut / goal.amount if task.resects else self.held / task.hold_steps
        time = STEP_SECONDS * self.step
        planned = replace(goal, position=self._compute_planned_target())
        return compute_states(task, planned, tracked, sensed, time, done, self.frame, self.setting.site.origin)

    def _collect_truth(self, response: Response, target: np.ndarray, is_success: bool) -> dict[str, Any]:
        """Return the ground truth, which is not observed, by name (see docs/gym.md). Arrays are new in each step."""
        assert self.judged is not None and self.drawn is not None
        setting = self.setting
        tumour = setting.site.anatomy.tumour_nodes
        now = setting.site.anatomy.mesh.nodes[tumour] + response.motion[np.searchsorted(response.nodes, tumour)]
        left = np.isin(tumour, setting.get_stage(self.shown).anatomy.tumour_nodes)
        return {
            "pose": self.actual.compute_pose(setting.task.tool),
            "force": response.force.copy(), "pressure": response.pressure,
            "tumour_nodes": now, "tumour_middle": now[left].mean(axis=0), "model_error": response.error,
            "target": target.copy(), "away": self.judged.distance, "asked": float(self.drawn.goal.amount),
            "reached": self._compute_reached(response), "load": self.judged.load_ratio, "violations": self.violations,
            "success": is_success, "reliable": response.reliable, "steps_done": self.shown,
        }  # fmt: skip
