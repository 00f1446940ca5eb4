"""Descriptions of the physical effects of a scene; the module `compile` converts each to a term or a constraint."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from operator import index
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np

from .anatomy import NECROSIS_LABEL, TUMOUR_LABEL, Anatomy, describe_region
from .errors import InputError
from .material import BRAIN, Tissue, check_attributes
from .skulls import Bonded, SkullContact, Slide, check_gap
from .tools import Spatula, Tool, check_tool

if TYPE_CHECKING:
    from .discretisation.body import Body
    from .discretisation.term import Term

# With these amplitudes of `Pulsation`, the exposed cortex of the template moves as observed in patients.
CARDIAC_AMPLITUDE = 4.5e-4  # amplitude of the heartbeat [volume fraction]
RESPIRATORY_AMPLITUDE = 4.5e-4  # amplitude of respiration [volume fraction]
MAX_WAVE_AMPLITUDE = 0.3  # maximum amplitude [volume fraction]


@dataclass(frozen=True)
class Elasticity:
    """Elasticity of tissue. `regions` maps region labels to tissue laws; all other regions have the law `default`.

    Necrosis without its own law has the law of the tumour. With `default=None` every region must have a law.

    Raises
    ------
    InputError
        A law is not a valid `Tissue`.
    """

    default: Tissue | None = BRAIN
    regions: Mapping[int, Tissue] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for tissue in (self.default, *self.regions.values()):
            if tissue is not None:
                check_attributes(tissue)

    def get_law(self, label: int) -> Tissue | None:
        """Return the tissue law of the region `label`; None if the region has no law."""
        return self.regions.get(label, self.regions.get(_get_enclosing_region(label), self.default))

    def restrict(self, labels: Iterable[int]) -> Elasticity:
        """Return the effect without the laws of regions that are not in `labels`."""
        obeyed = {each for label in labels for each in (label, _get_enclosing_region(label))}
        return replace(self, regions={label: law for label, law in self.regions.items() if label in obeyed})

    def __str__(self) -> str:
        """Return a description of the tissues, which is stored with results."""
        named = [] if self.default is None else [str(self.default)]
        return "; ".join([*named, *(f"{describe_region(label)}: {tissue}" for label, tissue in self.regions.items())])

    of, on = get_law, restrict  # Former names, for one release.


def _get_enclosing_region(label: int) -> int:
    """Return the label of the region whose law applies if the region `label` has no law; `label` if there is none."""
    return TUMOUR_LABEL if label == NECROSIS_LABEL else label


@dataclass(frozen=True)
class Held:
    """Fixed nodes: components marked in `Anatomy.fixed` have zero displacement, or the values of `Prescribed` loads."""


@dataclass(frozen=True)
class ToolForce:
    """Tool that pushes with a known force: each `Pushed` load becomes a dead traction on the footprint of the tool."""


@dataclass(frozen=True)
class ToolDisplacement:
    """Tool that moves the tissue under its footprint by a known vector: each `Displaced` load becomes a constraint."""


@dataclass(frozen=True)
class NodalForce:
    """Dead forces at mesh vertices, given by `Nodal` loads."""


@dataclass(frozen=True)
class Gravity:
    """Change of weight due to the head posture and the cerebrospinal fluid level, given by `Posture` loads.

    The scan shows the body in equilibrium under its weight, so only the change of weight since then acts:
    the weight in the `Posture` minus that in the scan, as dead loads in the undeformed configuration. Tissue above the
    fluid level weighs density x g, tissue below the level (density - csf_density) x g. The difference is buoyancy;
    the compression of tissue by the fluid pressure is neglected.

    The model neglects tissue that crosses the level, the densities of tumour and oedema, fluid in ventricles and
    cysts, and tissue that loses water or is resected. `Bonded` and `Slide` also suppress the gap that opens where
    the brain sinks away from the skull.

    Parameters
    ----------
    direction
        Direction of gravity in the scan (3,), nonzero, in mesh coordinates; default: supine in RAS.
    csf_level
        Height of the fluid in the scan [m] above the origin, against `direction`: points with
        -direction . x < csf_level are submerged. Infinite: the skull was closed and full.
    density, csf_density
        Densities of tissue and fluid [kg/m^3]; the defaults are common values.

    Raises
    ------
    InputError
        The direction is zero, the level is NaN, or a density is not positive.
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
            raise InputError("Gravity.csf_level is NaN: give a height [m], or infinity for a full skull.")
        for name, value in (("density", self.density), ("csf_density", self.csf_density)):
            if not 0.0 < value < math.inf:
                raise InputError(f"Gravity.{name} is {value} kg/m^3: give a positive number.")


@dataclass(frozen=True)
class Inertia:
    """Inertia of tissue: consecutive solutions form a time series, with one backward Euler step per solution.

    The time step is the time of the loads minus the time of the start solution, which also provides the initial
    displacements and velocities. Without a start solution, the tissue is initially undeformed and at rest. In a zero
    time step nothing moves. Backward Euler is first-order accurate and damps motion faster than the time step: the
    energy does not grow, and a long time step gives the static solution.

    Parameters
    ----------
    density
        Density of the tissue [kg/m^3].
    damping
        Damping force per mass and velocity [1/s], as in a viscous medium: free motion decays with exp(-damping t).

    Raises
    ------
    InputError
        The density is not positive, or the damping is negative.
    """

    density: float = 1040.0
    damping: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.density < math.inf:
            raise InputError(f"Inertia.density is {self.density} kg/m^3: give a positive number.")
        if not 0.0 <= self.damping < math.inf:
            raise InputError(f"Inertia.damping is {self.damping} 1/s: must be >= 0.")


@dataclass(frozen=True)
class Resection:
    """Removal of tissue in steps; `Resected` loads give the number of completed steps (default: all steps).

    The cavity wall is a free surface. A step also removes tissue without a connection, by element faces, to fixed
    tissue. `sim.build_fem` builds the solver.

    The remaining tissue keeps its history variables. Residual stress in the scan is not modelled, so without other
    loads nothing moves.

    Parameters
    ----------
    steps
        Numbers of the tetrahedra that each step removes.

    Raises
    ------
    InputError
        There are no steps, a step is empty, a number is not an integer, or a tetrahedron is removed twice.
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
                raise InputError(f"step {number} of Resection is empty: remove it.")
            for element in step:
                if element in taken:
                    raise InputError(
                        f"Resection takes tetrahedron {element} in step {taken[element]} and again in step {number}: "
                        "name it once."
                    )
                taken[element] = number


@dataclass(frozen=True)
class Wave:
    """Periodic relative volume change: amplitude x sin(2 pi frequency t).

    Parameters
    ----------
    frequency
        Frequency [Hz].
    amplitude
        Maximum volume change as a fraction of the volume; the peak-to-peak change is twice the amplitude.

    Raises
    ------
    InputError
        The frequency is not positive, or the amplitude is outside [0, 0.3].
    """

    frequency: float
    amplitude: float

    def __post_init__(self) -> None:
        if not 0.0 < self.frequency < math.inf:
            raise InputError(f"Wave.frequency is {self.frequency} Hz: give a positive number.")
        if not 0.0 <= self.amplitude <= MAX_WAVE_AMPLITUDE:
            raise InputError(
                f"Wave.amplitude is {self.amplitude}: must be a volume fraction from 0 to {MAX_WAVE_AMPLITUDE}; "
                "typical for brain: 0.0005."
            )


@dataclass(frozen=True)
class Pulsation:
    """Volume change of tissue by the blood volume of heartbeat and respiration, as a function of `Loads.time`.

    The relative volume change is uniform, without delay, and 0 at the time t = 0 of the scan. Tissue bulges through the
    craniotomy; compressible tissue bulges less. With the default amplitudes and tissue, the cortex of the template
    moves by up to 0.5 mm peak to peak in a craniotomy of 50 mm, as observed in patients. Each of the two default
    waves corresponds to half a millilitre of blood.

    Parameters
    ----------
    cardiac, respiratory
        Waves of heartbeat and respiration; their sum is the volume change.
    regions
        Labels of the regions whose volume changes; None: all regions.

    Raises
    ------
    InputError
        `regions` is an empty tuple.
    """

    cardiac: Wave = Wave(1.0, CARDIAC_AMPLITUDE)
    respiratory: Wave = Wave(0.2, RESPIRATORY_AMPLITUDE)
    regions: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        if self.regions is not None and not self.regions:
            raise InputError("Pulsation has no regions: name some, give None for all, or remove the effect.")

    def compute_swelling(self, times: np.ndarray) -> np.ndarray:
        """Return the relative volume change (B,) at times (B,) [s]."""
        waves = (self.cardiac, self.respiratory)
        return sum((wave.amplitude * np.sin(2.0 * np.pi * wave.frequency * times) for wave in waves), np.zeros(()))

    swelling = compute_swelling  # Former names, for one release.


@dataclass(frozen=True)
class ToolContact:
    """Frictionless contact of tissue with rigid tools, whose poses are given by `Touching` loads.

    Contact forces start at a distance of `gap` [m]; the distance always exceeds a few hundredths of `gap`. Tools
    can only touch surface that is neither fixed nor under the skull.

    Raises
    ------
    InputError
        There is no tool, a value is not a tool, or the gap is not positive.
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
    """Retractor blade that is placed on the tissue and then moved; `Retracted` loads give its pose and displacement.

    The contact model and its `gap` [m] are those of `ToolContact`; the reaction is the force that holds the blade.

    Raises
    ------
    InputError
        The blade is not a `Spatula`, or the gap is not positive.
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
"""Effects of this package."""


@runtime_checkable
class OwnEffect(Protocol):
    """Interface of user-defined effects: frozen dataclasses that build their own `Term`; see `docs/extend.md`."""

    @property
    def cause(self) -> type | None:
        """Type of the load cause that the effect requires; None if the effect acts without loads."""
        ...

    @property
    def remembers(self) -> bool:
        """True if a solution depends on the previous solution, so that a scene must be solved from its first frame."""
        ...

    def term(self, body: Body) -> Term:
        """Return the energy term of this effect on a body. Modules that only the term needs are imported here."""
        ...


Effect = BuiltIn | OwnEffect
"""Type of all effects of a scene."""


SKULLS = {"bonded": Bonded(), "slide": Slide(), "contact": SkullContact()}
"""Skull models by name; the first model is recommended, the other two are its frictionless limits."""


def build_push_effects(anatomy: Anatomy, tissue: Tissue | Elasticity, skull: str = "bonded") -> tuple[Effect, ...]:
    """Return the effects for a pushing tool on tissue, with a skull model of `SKULLS` if the anatomy has a skull."""
    made = tissue if isinstance(tissue, Elasticity) else Elasticity(tissue)
    covered = (SKULLS[skull],) if anatomy.slide_normal.any() else ()
    return (made, Held(), *covered, ToolForce())


def has_history(effects: Iterable[Effect]) -> bool:
    """Return True if a solution depends on the previous solution, by tool path, velocity, relaxation or resection."""
    return any(map(_is_history_dependent, effects))


def _is_history_dependent(effect: Effect) -> bool:
    match effect:
        case Inertia() | ToolContact() | Retraction() | Resection():
            return True
        case Elasticity():
            return any(tissue.prony for tissue in (effect.default, *effect.regions.values()) if tissue is not None)
        case OwnEffect():
            return effect.remembers
        case _:
            return False
