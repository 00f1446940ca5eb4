"""Definition of the tasks: tool, goal, step sizes, and limits of force and pressure."""

from dataclasses import dataclass, replace

import numpy as np

from sim.effects import Bonded, Elasticity, Gravity, Held, SkullContact, ToolContact
from sim.errors import InputError
from sim.named_tissues import MATERIALS

from ..script.debulking import Debulking
from ..script.scene import Scene
from ..script.tool import Blade, Instrument, Probe
from ..script.viewpoint import OBLIQUE_VIEWPOINT, PLAIN_APPEARANCE

STEP_SECONDS = 0.05
"""Duration of a step [s]."""
MAX_LOAD_RATIO = 1.25
"""Ratio of a load to its limit above which an episode ends."""


@dataclass(frozen=True)
class Goal:
    """Goal of an episode, which the plan of the operation prescribes.

    Parameters
    ----------
    position
        Goal position (3,) [m] in the scan.
    direction
        Unit vector (3,) of the direction in which tissue is pressed or drawn.
    amount
        Requested force [N], distance [m], or number of parts to resect.
    fluid
        Final CSF level, from 0 (drained) to 1 (full).
    """

    position: np.ndarray
    direction: np.ndarray
    amount: float
    fluid: float = 1.0


@dataclass(frozen=True)
class GymTask:
    """Task of an environment; lengths in metres.

    Parameters
    ----------
    name, title
        Name in lower case, and description.
    tool
        Tool of the robot.
    max_force, max_pressure
        Limits of the force on the tissue [N], and of the pressure under the tool [Pa].
    amount
        Range of the goal's amount; and amount for which the observed value is 1.
    tolerance
        Tolerance of the amount, relative to the requested amount.
    max_distance
        Maximum distance of the tool from its goal position [m].
    hold_steps
        Number of consecutive steps for which the goal must be kept.
    max_push_angle
        Maximum angle between the goal's direction and the inward axis [rad].
    step, turn
        Translation [m] and rotation [rad] in a step for an action of 1.
    max_tilt
        Maximum tilt of the tool relative to its initial orientation [rad].
    max_depth
        Maximum depth of the tool below the centre of the open cortex [m].
    resects
        True if tissue is resected.
    """

    name: str
    title: str
    tool: Instrument
    max_force: float
    max_pressure: float
    amount: tuple[float, float]
    unit: float
    tolerance: float
    max_distance: float
    hold_steps: int
    max_push_angle: float = 0.0
    step: float = 1e-3
    turn: float = float(np.radians(2.0))
    max_tilt: float = float(np.radians(40.0))
    max_depth: float = 0.02
    resects: bool = False

    @property
    def surgery(self) -> Debulking | None:
        """Schedule of the resection (corridor, then parts of the tumour except the last); None without resection."""
        return Debulking(tuple(float(each) for each in range(int(self.amount[1]) + 1))) if self.resects else None

    def build_scene(self, size: tuple[int, int]) -> Scene:
        """Build the scene of the task; `size` is the width and height of images [pixel]."""
        view = replace(OBLIQUE_VIEWPOINT, width=size[0], height=size[1])
        if self.resects:
            effects = Elasticity(MATERIALS["drained"].tissue), Held(), SkullContact(), Gravity()
            return Scene(
                self.name, self.title, effects=effects, tool=self.tool, surgery=self.surgery, viewpoint=view,
                look=PLAIN_APPEARANCE, element="p1",
            )  # fmt: skip
        effects = Elasticity(), Held(), Bonded(), ToolContact((self.tool.shape,))
        return Scene(self.name, self.title, effects=effects, tool=self.tool, viewpoint=view, look=PLAIN_APPEARANCE)


@dataclass(frozen=True)
class Aspirator(Probe):
    """Tip of an ultrasonic aspirator: a small ball on a straight, thin shaft."""

    radius: float = 2e-3
    shaft: float = 1e-3
    length: float = 0.14
    lean: float = 0.1


PALPATE = GymTask(
    "palpate", "Press on the cortex over the tumour with the force that is asked for, and hold it.",
    Probe(radius=6e-3), max_force=0.25, max_pressure=2.7e3, amount=(0.06, 0.15), unit=0.25, tolerance=0.15,
    max_distance=3e-3, hold_steps=5,
)  # fmt: skip
RETRACT = GymTask(
    "retract", "Lay a spatula on the cortex, draw it aside as far as is asked for, and hold it.",
    Blade(), max_force=0.5, max_pressure=4e3, amount=(1.5e-3, 3.5e-3), unit=5e-3, tolerance=0.15,
    max_distance=6e-3, hold_steps=5, max_push_angle=float(np.radians(30.0)),
)  # fmt: skip
DEBULK = GymTask(
    "debulk", "Follow the tumour as it sinks, and suck it out share by share, without pressing on healthy tissue.",
    Aspirator(), max_force=0.02, max_pressure=2e3, amount=(3.0, 3.0), unit=3.0, tolerance=0.0, max_distance=4e-3,
    hold_steps=5, max_depth=0.06, resects=True,
)  # fmt: skip
TASKS = {task.name: task for task in (PALPATE, RETRACT, DEBULK)}
"""Tasks by name."""


def find_task(name: object) -> GymTask:
    """Return a task by name.

    Raises
    ------
    InputError
        No task has this name.
    """
    if isinstance(name, str) and name in TASKS:
        return TASKS[name]
    raise InputError(f"no task is called {name!r:.80}: choose one of {', '.join(TASKS)}.")
