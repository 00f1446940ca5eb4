"""Families of tool motions of episodes, with their random parameters."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any

import msgspec
import numpy as np

from sim.effects import Effect, Gravity, Retraction, ToolContact, ToolForce

from ..builtin.retract import RELAXING_BRAIN
from ..script.camera_paths import sample_hand_motion
from ..script.debulking import Debulking
from ..script.head_pose import Lie, build_drained_turn, get_supine_pose
from ..script.tool import Blade, Instrument, Probe
from ..script.tool_paths import Path, Touch, draw, keep_idle, lay, palpate, press, slide, smooth_step
from .draws import Number, ValueLimits

PRONY = RELAXING_BRAIN.prony
"""Prony series of tissue that relaxes under a spatula."""
REST_SHARE = 0.3  # Share of the time between two places in which the tool is lifted and moves on.


class FamilyMotion(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of the families of a plan, with the relative frequency (`weight`) of a family."""

    weight: Annotated[float, ValueLimits(0, 100_000)] = 1.0


class Pushing(FamilyMotion, frozen=True):
    """Base of families in which a ball pushes with a force; `spread` (0 to 1): distance from the centre."""

    force_n: Annotated[Number, ValueLimits(0.01, 2, "N")] = (0.05, 0.35)
    radius_mm: Annotated[Number, ValueLimits(1, 15, "mm")] = (5.0, 7.5)
    spread: Annotated[Number, ValueLimits(0, 1)] = (0.0, 1.0)


class Press(Pushing, frozen=True):
    """Family in which a ball presses one position obliquely, stays, and releases."""

    tilt_deg: Annotated[Number, ValueLimits(0, 45, "°")] = (0.0, 25.0)


class SlideMotion(Pushing, frozen=True):
    """Family in which a ball presses, slides along a straight line, and releases."""

    force_n: Annotated[Number, ValueLimits(0.01, 2, "N")] = (0.05, 0.3)


class DrawMotion(Pushing, frozen=True):
    """Family in which a ball presses, and draws the tissue aside."""

    force_n: Annotated[Number, ValueLimits(0.01, 2, "N")] = (0.05, 0.25)
    tilt_deg: Annotated[Number, ValueLimits(0, 45, "°")] = (20.0, 40.0)


class Reach(Pushing, frozen=True):
    """Family in which a ball touches several positions in sequence, with minimum-jerk motions in between."""

    places: Annotated[Number, ValueLimits(2, 12)] = (2.0, 5.0)


class Walk(Pushing, frozen=True):
    """Family in which a ball moves at random with a random force, always in contact."""

    force_n: Annotated[Number, ValueLimits(0.01, 2, "N")] = (0.05, 0.25)


class Palpate(FamilyMotion, frozen=True):
    """Family in which a ball with prescribed pose sinks into the cortex and slides along it; solved by FEM."""

    depth_mm: Annotated[Number, ValueLimits(0.5, 10, "mm")] = (1.0, 4.0)
    radius_mm: Annotated[Number, ValueLimits(3, 15, "mm")] = 7.0
    spread: Annotated[Number, ValueLimits(0, 1)] = (0.0, 0.8)


class Retract(FamilyMotion, frozen=True):
    """Family in which a spatula draws the cortex aside while the tissue relaxes; solved by FEM."""

    depth_mm: Annotated[Number, ValueLimits(0.5, 12, "mm")] = (3.0, 8.0)
    tilt_deg: Annotated[Number, ValueLimits(0, 40, "°")] = (10.0, 30.0)
    spread: Annotated[Number, ValueLimits(0, 1)] = (0.0, 0.3)


class Drain(FamilyMotion, frozen=True):
    """Family in which CSF drains to the level `fluid` and the head turns; the brain can separate; solved by FEM."""

    fluid: Annotated[Number, ValueLimits(0, 1)] = (0.0, 0.7)
    turn_deg: Annotated[Number, ValueLimits(-60, 60, "°")] = (-30.0, 30.0)


class Debulk(FamilyMotion, frozen=True):
    """Family in which CSF drains to the level `fluid` and the tumour is resected in parts; solved by FEM."""

    fluid: Annotated[Number, ValueLimits(0, 1)] = (0.2, 0.7)
    steps: Annotated[Number, ValueLimits(2, 8)] = (3.0, 5.0)


class FamilyMotions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Scenarios of a sampling configuration, by type of tool motion; an entry is None if it is not used."""

    press: Press | None = None
    slide: SlideMotion | None = None
    draw: DrawMotion | None = None
    reach: Reach | None = None
    walk: Walk | None = None
    palpate: Palpate | None = None
    retract: Retract | None = None
    drain: Drain | None = None
    debulk: Debulk | None = None

    @property
    def named(self) -> dict[str, FamilyMotion]:
        """Families that the plan contains, by name."""
        found = {name: getattr(self, name) for name in self.__struct_fields__}
        return {name: motion for name, motion in found.items() if motion is not None}


@dataclass(frozen=True)
class Scenario:
    """Scenario of an episode: tool motion, effects and head pose.

    Parameters
    ----------
    path, tool, lying, surgery
        See `Scene`.
    effects
        Effects in addition to tissue, constraints and skull.
    is_viscoelastic
        True if the tissue relaxes.
    skull_separates
        True if the brain can separate from the skull, regardless of the body's skull model.
    """

    path: Path = keep_idle
    tool: Instrument | None = None
    effects: tuple[Effect, ...] = (ToolForce(),)
    lying: Lie = get_supine_pose
    surgery: Debulking | None = None
    is_viscoelastic: bool = False
    skull_separates: bool = False


@dataclass(frozen=True)
class ScenarioInputs:
    """Inputs for sampling a scenario: sampled values, random generator, and duration [s].

    `reach` is a function from a tool's radius [m] to the tool's maximum distance [m] from the craniotomy's axis.
    """

    values: Mapping[str, Any]
    random: np.random.Generator
    seconds: float
    reach: Callable[[float], float]

    def sample_position(self, radius: float) -> tuple[float, float]:
        """Sample a position [m] of a tool of this radius [m] in the tangent plane of the open cortex."""
        far = self.values["spread"] * self.reach(radius)
        angle = self.random.uniform(0.0, 2.0 * np.pi)
        return far * float(np.cos(angle)), far * float(np.sin(angle))

    @property
    def probe(self) -> Probe:
        """Ball of the sampled radius."""
        return Probe(radius=1e-3 * self.values["radius_mm"])


def sample_press_scenario(inputs: ScenarioInputs) -> Scenario:
    """Scenario of `Press`."""
    probe = inputs.probe
    at = inputs.sample_position(probe.radius)
    tilt, angle = np.radians(inputs.values["tilt_deg"]), inputs.random.uniform(0.0, 2.0 * np.pi)
    aslant = float(tilt * np.cos(angle)), float(tilt * np.sin(angle))
    way = press(inputs.values["force_n"], 0.35 * inputs.seconds, 0.2 * inputs.seconds, at)

    def get_touch(time: float) -> Touch:
        return replace(way(time), tilt=aslant)

    return Scenario(get_touch, probe)


def sample_slide_scenario(inputs: ScenarioInputs) -> Scenario:
    """Scenario of `SlideMotion`."""
    probe = inputs.probe
    start, end = inputs.sample_position(probe.radius), inputs.sample_position(probe.radius)
    rise = 0.12 * inputs.seconds
    return Scenario(slide(inputs.values["force_n"], start, end, inputs.seconds - 2.0 * rise, rise), probe)


def sample_draw_scenario(inputs: ScenarioInputs) -> Scenario:
    """Scenario of `DrawMotion`."""
    probe, rise = inputs.probe, 0.25 * inputs.seconds
    tilt, at = float(np.radians(inputs.values["tilt_deg"])), inputs.sample_position(probe.radius)
    way = draw(inputs.values["force_n"], tilt, rise, 0.2 * inputs.seconds, at)
    angle = float(inputs.random.uniform(0.0, 2.0 * np.pi))

    def get_touch(time: float) -> Touch:
        touch = way(time)
        return replace(touch, tilt=(touch.tilt[0] * float(np.cos(angle)), touch.tilt[0] * float(np.sin(angle))))

    return Scenario(get_touch, probe)


def sample_reach_scenario(inputs: ScenarioInputs) -> Scenario:
    """Scenario of `Reach`."""
    probe, count = inputs.probe, round(inputs.values["places"])
    places = np.array([inputs.sample_position(probe.radius) for _ in range(count)])
    forces = inputs.values["force_n"] * inputs.random.uniform(0.5, 1.0, count)
    takes = inputs.seconds / count

    def get_touch(time: float) -> Touch:
        number = min(int(time / takes), count - 1)
        share = time / takes - number
        # In the last part the tool moves to the next place, lifted; before, it presses and releases.
        on = smooth_step((share - (1.0 - REST_SHARE)) / REST_SHARE)
        x, y = (1.0 - on) * places[number] + on * places[min(number + 1, count - 1)]
        half = 0.5 * (1.0 - REST_SHARE)
        pressed = smooth_step(share / half) - smooth_step(share / half - 1.0)
        return Touch(float(x), float(y), float(forces[number] * pressed))

    return Scenario(get_touch, probe)


def sample_walk_scenario(inputs: ScenarioInputs) -> Scenario:
    """Scenario of `Walk`."""
    probe, seed = inputs.probe, int(inputs.random.integers(2**31))
    far, force = 0.5 * inputs.values["spread"] * inputs.reach(probe.radius), inputs.values["force_n"]

    def get_touch(time: float) -> Touch:
        way = sample_hand_motion(seed, time)
        begun = smooth_step(time / (0.15 * inputs.seconds))
        return Touch(float(far * way[0]), float(far * way[1]), force * begun * float(np.clip(0.6 + 0.2 * way[2], 0, 1)))

    return Scenario(get_touch, probe)


def sample_palpate_scenario(inputs: ScenarioInputs) -> Scenario:
    """Scenario of `Palpate`."""
    probe, rise = inputs.probe, 0.2 * inputs.seconds
    start, end = inputs.sample_position(probe.radius), inputs.sample_position(probe.radius)
    way = palpate(1e-3 * inputs.values["depth_mm"], start, end, inputs.seconds - 2.0 * rise, rise)
    return Scenario(way, probe, (ToolContact((probe.shape,)),))


def sample_retract_scenario(inputs: ScenarioInputs) -> Scenario:
    """Scenario of `Retract`."""
    blade = Blade()
    tilt, at = float(np.radians(inputs.values["tilt_deg"])), inputs.sample_position(blade.radius)
    way = lay(1e-3 * inputs.values["depth_mm"], tilt, 0.4 * inputs.seconds, at)
    return Scenario(way, blade, (Retraction(blade.shape),), is_viscoelastic=True)


def sample_drain_scenario(inputs: ScenarioInputs) -> Scenario:
    """Scenario of `Drain`."""
    turn, fluid = float(np.radians(inputs.values["turn_deg"])), inputs.values["fluid"]
    lie = build_drained_turn(0.5 * inputs.seconds, 0.1 * inputs.seconds, 0.3 * inputs.seconds, turn, fluid)
    return Scenario(effects=(Gravity(),), lying=lie, skull_separates=True)


def sample_debulk_scenario(inputs: ScenarioInputs) -> Scenario:
    """Scenario of `Debulk`."""
    count, fluid = round(inputs.values["steps"]), inputs.values["fluid"]
    lie = build_drained_turn(0.3 * inputs.seconds, 0.0, 1.0, 0.0, fluid)
    times = tuple((inputs.seconds * np.linspace(0.4, 0.9, count)).tolist())
    return Scenario(effects=(Gravity(),), lying=lie, surgery=Debulking(times), skull_separates=True)


FAMILIES: dict[str, Callable[[ScenarioInputs], Scenario]] = {
    "press": sample_press_scenario, "slide": sample_slide_scenario, "draw": sample_draw_scenario,
    "reach": sample_reach_scenario, "walk": sample_walk_scenario, "palpate": sample_palpate_scenario,
    "retract": sample_retract_scenario, "drain": sample_drain_scenario, "debulk": sample_debulk_scenario,
}  # fmt: skip
"""Scenario of each family of `FamilyMotions`."""


def add_tremor(path: Path, seed: int, position_sigma: float, force_sigma: float) -> Path:
    """Return a path with hand tremor: standard deviations of position [m], and of force [N] while the tool pushes."""

    def get_touch(time: float) -> Touch:
        touch, way = path(time), sample_hand_motion(seed, time)
        pushed = max(0.0, touch.force + force_sigma * float(way[2])) if touch.force > 0.0 else touch.force
        right, up = (position_sigma * way[:2]).tolist()
        return replace(touch, x=touch.x + right, y=touch.y + up, force=pushed)

    return get_touch
