"""What a scene may ask for: descriptions only. `compile` turns each into a term or a constraint."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from operator import index
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np

from .anatomy import NECROSIS_LABEL, TUMOUR_LABEL, Anatomy, describe_region
from .errors import InputError
from .material import BRAIN, Tissue, check_described
from .skulls import Bonded, SkullContact, Slide, check_gap
from .tools import Spatula, Tool, check_tool

if TYPE_CHECKING:
    from .discretisation.body import Body
    from .discretisation.term import Term

# Of `Pulsation`: shares of the volume, by which the opened template moves as much as opened brains do.
CARDIAC, RESPIRATORY = 4.5e-4, 4.5e-4
LARGEST_WAVE = 0.3


@dataclass(frozen=True)
class Elasticity:
    """Tissue resists deformation. `regions` names the law of each region label; the rest obeys `default`.

    Necrosis without a law of its own obeys the tumour's. `default=None` makes a region without a law an error.

    Raises
    ------
    InputError
        What is no tissue.
    """

    default: Tissue | None = BRAIN
    regions: Mapping[int, Tissue] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for tissue in (self.default, *self.regions.values()):
            if tissue is not None:
                check_described(tissue)

    def of(self, label: int) -> Tissue | None:
        """Return the law of a region, if it has any."""
        return self.regions.get(label, self.regions.get(_around(label), self.default))

    def on(self, labels: Iterable[int]) -> Elasticity:
        """Return the same for a body of these regions: without laws that none of them obeys."""
        obeyed = {each for label in labels for each in (label, _around(label))}
        return replace(self, regions={label: law for label, law in self.regions.items() if label in obeyed})

    def __str__(self) -> str:
        """Return the tissues as they are named beside every answer."""
        named = [] if self.default is None else [str(self.default)]
        return "; ".join([*named, *(f"{describe_region(label)}: {tissue}" for label, tissue in self.regions.items())])


def _around(label: int) -> int:
    """Return the region that a region lies in, or itself."""
    return TUMOUR_LABEL if label == NECROSIS_LABEL else label


@dataclass(frozen=True)
class Held:
    """Components marked in `Anatomy.held` do not move, or move as `Prescribed` loads say."""


@dataclass(frozen=True)
class ToolForce:
    """A tool pushes with a known force: `Pushed` loads become dead tractions on its footprint."""


@dataclass(frozen=True)
class ToolDisplacement:
    """A tool moves the tissue under its footprint by a known vector: `Displaced` loads are constraints."""


@dataclass(frozen=True)
class NodalForce:
    """Dead forces at the mesh's own nodes: `Nodal` loads."""


@dataclass(frozen=True)
class Gravity:
    """Tissue weighs less under the cerebrospinal fluid than above it; `Posture` loads say how the head lies now.

    The scan shows a body in equilibrium with its weight then, so that only the change since acts. What acts is the
    weight as a `Posture` has it less the weight in the scan, as dead forces in the rest configuration. Tissue above the
    level weighs density x g, under it (density - csf_density) x g. The latter is Archimedes' body force, which is the
    fluid's pressure on the tissue but for how much that squeezes it.

    Left out are tissue that moves through the level, densities of tumour and oedema, and fluid that does not surround
    the tissue (ventricles, cysts). So is tissue that loses water or is cut out. So is the gap that opens where the
    brain sinks away from the skull: with `Bonded` and `Slide` it stays on it.

    Parameters
    ----------
    direction
        Which way gravity pulled in the scan (3,), of any length but none, in the mesh's frame; supine in RAS.
    csf_level
        How high the fluid stood in the scan [m] above the origin, against `direction`: what has
        -direction . x < csf_level is under it. Infinite: the skull was closed and full.
    density, csf_density
        Of tissue and fluid [kg/m^3]; customary values.

    Raises
    ------
    InputError
        A direction of no length, a level that is no number, a density that is not positive.
    """

    direction: tuple[float, float, float] = (0.0, -1.0, 0.0)
    csf_level: float = math.inf
    density: float = 1040.0
    csf_density: float = 1007.0

    def __post_init__(self) -> None:
        given = all(map(math.isfinite, self.direction)) and any(self.direction)
        if len(self.direction) != 3 or not given:
            raise InputError(f"Gravity.direction is {self.direction}: give three finite numbers, not all zero.")
        if math.isnan(self.csf_level):
            raise InputError("Gravity.csf_level is no number: give a height [m], or infinity for a full skull.")
        for name, value in (("density", self.density), ("csf_density", self.csf_density)):
            if not 0.0 < value < math.inf:
                raise InputError(f"Gravity.{name} is {value} kg/m^3: give a positive number.")


@dataclass(frozen=True)
class Inertia:
    """Tissue keeps its velocity: answers follow one another in time, one step of backward Euler each.

    The step is the time of the loads less the time of the start. At that time the nodes stood where the start has them,
    with the velocities of its memory; at rest without one. Where no time passes the body and the tools that touch it
    stay as they are, whatever acts. Backward Euler is of first order in the step and damps what swings faster than
    that: energy does not grow, and one long step is statics.

    Parameters
    ----------
    density
        Of the tissue [kg/m^3].
    damping
        Force per mass and velocity [1/s], as of a body in a medium at rest: free motion decays with exp(-damping t).

    Raises
    ------
    InputError
        A density that is not positive, damping that is negative.
    """

    density: float = 1040.0
    damping: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.density < math.inf:
            raise InputError(f"Inertia.density is {self.density} kg/m^3: give a positive number.")
        if not 0.0 <= self.damping < math.inf:
            raise InputError(f"Inertia.damping is {self.damping} 1/s: give a number that is not negative.")


@dataclass(frozen=True)
class Resection:
    """Tissue is taken away, step after step; `Resected` loads say how many steps are done, without them all are.

    The wall of the cavity is free surface. What a step loosens (a piece joined by no face to anything held) goes with
    it. `sim.finite_elements` makes what solves it.

    What is left remembers what it went through. Left out: the stress that the scan's own equilibrium holds, so that
    without another load nothing moves.

    Parameters
    ----------
    steps
        Of each step the numbers of the tetrahedra that it takes.

    Raises
    ------
    InputError
        No steps, steps that are no whole numbers, a step that takes nothing, a tetrahedron that is taken twice.
    """

    steps: tuple[tuple[int, ...], ...]

    def __post_init__(self) -> None:
        try:
            steps = tuple(tuple(index(number) for number in step) for step in self.steps)
        except TypeError as error:
            raise InputError("Resection.steps are not numbers of tetrahedra: give those of each step.") from error
        object.__setattr__(self, "steps", steps)
        if not self.steps:
            raise InputError("Resection has no steps: give the tetrahedra of at least one, or leave it out.")
        taken: dict[int, int] = {}
        for number, step in enumerate(self.steps, start=1):
            if not step:
                raise InputError(f"step {number} of Resection takes nothing: leave it out.")
            for element in step:
                if element in taken:
                    raise InputError(
                        f"Resection takes tetrahedron {element} in step {taken[element]} and again in step {number}: "
                        "name it once."
                    )
                taken[element] = number


@dataclass(frozen=True)
class Wave:
    """A periodic change of volume, amplitude sin(2 pi frequency t): none at t = 0.

    Parameters
    ----------
    frequency
        [Hz].
    amplitude
        The largest change as a share of the volume; half of what lies between the largest and the smallest.

    Raises
    ------
    InputError
        A frequency that is not positive, an amplitude outside [0, 0.3].
    """

    frequency: float
    amplitude: float

    def __post_init__(self) -> None:
        if not 0.0 < self.frequency < math.inf:
            raise InputError(f"Wave.frequency is {self.frequency} Hz: give a positive number.")
        if not 0.0 <= self.amplitude <= LARGEST_WAVE:
            raise InputError(
                f"Wave.amplitude is {self.amplitude} of the volume: give a share from 0 to {LARGEST_WAVE}; "
                "of brain, some thousandths."
            )


@dataclass(frozen=True)
class Pulsation:
    """Tissue swells and shrinks with heartbeat and breath, by its blood: `Loads.time` alone says how much.

    By the same share at every point, without delay; where the skull is open it bulges. As it was in the scan at t = 0.
    With the default amplitudes and tissue the template's cortex in an opening of 50 mm moves by up to half a millimetre
    from peak to peak, as is observed. That is half a millilitre of blood each. The more tissue gives in volume the less
    it bulges.

    Parameters
    ----------
    cardiac, respiratory
        What heart and breath do; they add up.
    regions
        Labels of the regions that swell; None: all.

    Raises
    ------
    InputError
        No region.
    """

    cardiac: Wave = Wave(1.0, CARDIAC)
    respiratory: Wave = Wave(0.2, RESPIRATORY)
    regions: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        if self.regions is not None and not self.regions:
            raise InputError("Pulsation swells no region: name some, give None for all, or leave the effect out.")

    def swelling(self, times: np.ndarray) -> np.ndarray:
        """Change of volume (B,) as a share of it, at times (B,) [s]."""
        waves = (self.cardiac, self.respiratory)
        return sum((wave.amplitude * np.sin(2.0 * np.pi * wave.frequency * times) for wave in waves), np.zeros(()))


@dataclass(frozen=True)
class ToolContact:
    """Rigid tools, moved by pose, press and slide without friction on the tissue that they touch: `Touching` loads.

    Tissue begins to feel a tool at a distance of `gap` [m], and is never nearer than a few hundredths of that. Only
    what no bone covers is touched: surface that is neither held nor under the skull.

    Raises
    ------
    InputError
        No tool, what is no tool, or a gap that is not positive.
    """

    tools: tuple[Tool, ...]
    gap: float = 1e-4

    def __post_init__(self) -> None:
        object.__setattr__(self, "tools", tuple(self.tools) if isinstance(self.tools, Iterable) else (self.tools,))
        if not self.tools:
            raise InputError("ToolContact has no tool: give at least one, such as Ball(7e-3), or leave the effect out.")
        for tool in self.tools:
            check_tool("ToolContact", tool)
        check_gap(type(self).__name__, self.gap)


@dataclass(frozen=True)
class Retraction:
    """A blade is laid on the tissue and held at a displacement: `Retracted` loads.

    As `ToolContact`, whose `gap` [m] it has; what it takes to hold the blade comes out as its reaction.

    Raises
    ------
    InputError
        A blade that is none, or a gap that is not positive.
    """

    blade: Spatula
    gap: float = 1e-4

    def __post_init__(self) -> None:
        if not isinstance(self.blade, Spatula):
            raise InputError(f"Retraction has {self.blade!r} for a blade: give a Spatula; ToolContact has other tools.")
        check_gap(type(self).__name__, self.gap)


BuiltIn = (
    Elasticity
    | Held
    | Bonded
    | Slide
    | ToolForce
    | ToolDisplacement
    | NodalForce
    | Gravity
    | Inertia
    | Pulsation
    | Resection
    | ToolContact
    | Retraction
    | SkullContact
)
"""The effects that this package knows."""


@runtime_checkable
class OwnEffect(Protocol):
    """An effect of your own, as a frozen dataclass: it builds its `Term` itself. `docs/extend.md` works one out."""

    @property
    def cause(self) -> type | None:
        """The kind of cause that it answers; None: it acts by itself."""
        ...

    @property
    def remembers(self) -> bool:
        """Whether an answer depends on the one before, so that a scene cannot be entered in its middle."""
        ...

    def term(self, body: Body) -> Term:
        """Its summand of the potential on a body. Import here what only the term needs."""
        ...


Effect = BuiltIn | OwnEffect
"""Everything that a scene may ask for."""


SKULLS = {"bonded": Bonded(), "slide": Slide(), "contact": SkullContact()}
"""What the skull may do, by name; the first is recommended, the others are its brackets."""


def pushed_effects(anatomy: Anatomy, tissue: Tissue | Elasticity, skull: str = "bonded") -> tuple[Effect, ...]:
    """What a tool that pushes on a body of this tissue calls for; one of `SKULLS` where the anatomy has a skull."""
    made = tissue if isinstance(tissue, Elasticity) else Elasticity(tissue)
    covered = (SKULLS[skull],) if anatomy.slide_normal.any() else ()
    return (made, Held(), *covered, ToolForce())


def remember(effects: Iterable[Effect]) -> bool:
    """Whether an answer depends on the one before: where tools were, velocities, stress that fades, what was cut."""
    return any(map(_remembers, effects))


def _remembers(effect: Effect) -> bool:
    match effect:
        case Inertia() | ToolContact() | Retraction() | Resection():
            return True
        case Elasticity():
            return any(tissue.prony for tissue in (effect.default, *effect.regions.values()) if tissue is not None)
        case OwnEffect():
            return effect.remembers
        case _:
            return False
