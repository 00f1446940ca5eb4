"""What a skull may do to the brain under it: descriptions only."""

import math
from dataclasses import dataclass

from .errors import InputError


@dataclass(frozen=True)
class Bonded:
    """The meninges bind the brain to the skull: nodes with a normal in `Anatomy.slide_normal` do not move.

    The limit of an elastic layer. In the default brain one with 0.1 kPa of shear per mm moves the tumour 2 % more. What
    was measured is stiffer (11 MPa per mm under compression: Mazumder et al. 2013, Acta Bioeng. Biomech. 15(2):3-11).
    It holds as long as the traction stays below the bond's strength: `Deformation.bond` tells how near it comes.
    `Slide` and `SkullContact`, without friction, are its brackets.

    Parameters
    ----------
    tension, shear
        Strengths [Pa]; of sheep, the least of 2.8 to 3.4 and of 1.8 to 2.1 kPa (Arzemanzadeh, Miller, Rosenow, Vos,
        Wittek 2025, arXiv 2512.08425).

    Raises
    ------
    InputError
        A strength that is not positive.
    """

    tension: float = 2.8e3
    shear: float = 1.8e3

    def __post_init__(self) -> None:
        for name, value in (("tension", self.tension), ("shear", self.shear)):
            if not 0.0 < value < math.inf:
                raise InputError(f"Bonded.{name} is {value} Pa: give a positive number.")


@dataclass(frozen=True)
class Slide:
    """Nodes with a normal in `Anatomy.slide_normal` do not move along it; tangentially they are free.

    A wall that neither lets go nor resists shear. Every undulation of the wall holds the tissue that slides in it, so
    that the motion of a deep tumour depends on how smooth the surface is.
    """


@dataclass(frozen=True)
class SkullContact:
    """The skull holds the brain on its side without friction, and lets go of it: where `Slide` would keep it on.

    Nodes with a normal in `Anatomy.slide_normal` stay on their side of a wall across it, `gap` [m] above where they are
    at rest. The wall bends as the normals round them do; they feel it in the last tenth of a millimetre. Nodes of the
    craniotomy rise in it freely, but meet bone beyond its edge, which is as round as the mesh is coarse there. The body
    needs what `Held` holds: bone alone only bars its way.

    What the gap holds may pass the closed skull, and `Deformation.leaked` counts it: 0.1 mm round a brain are 6 ml.

    Parameters
    ----------
    gap
        [m] between brain and bone at rest.

    Raises
    ------
    InputError
        A gap that is not positive.
    """

    gap: float = 1e-4

    def __post_init__(self) -> None:
        check_gap("SkullContact", self.gap)


def check_gap(effect: str, gap: float) -> None:
    """Refuse a gap [m] between bodies that is not positive."""
    if not 0.0 < gap < math.inf:
        raise InputError(f"{effect}.gap is {gap} m: give a positive number.")
