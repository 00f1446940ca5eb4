"""Contact models of brain and skull, as descriptions."""

import math
from dataclasses import dataclass

from .errors import InputError


@dataclass(frozen=True)
class Bonded:
    """Brain bonded to the skull by the meninges: nodes with a normal in `Anatomy.slide_normal` do not move.

    Stiff limit of an elastic layer. In the default brain, a layer of 0.1 kPa shear per mm moves the tumour 2 % more.
    The measured one is stiffer (11 MPa per mm in compression: Mazumder et al. 2013, Acta Bioeng. Biomech. 15(2):3-11).
    Valid while the traction is below the bond's strength; `Deformation.bond` gives the largest ratio.
    `Slide` and `SkullContact` are the frictionless limits.

    Parameters
    ----------
    tension, shear
        Tensile and shear strength [Pa]; of sheep, the minima of 2.8 to 3.4 and of 1.8 to 2.1 kPa (Arzemanzadeh, Miller,
        Rosenow, Vos, Wittek 2025, arXiv 2512.08425).

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
    """Frictionless sliding: nodes with a normal in `Anatomy.slide_normal` move only perpendicular to it.

    The wall does not separate and has no shear resistance. Undulations of the wall obstruct sliding tissue, so
    the motion of a deep tumour depends on the smoothness of the surface.
    """


@dataclass(frozen=True)
class SkullContact:
    """Frictionless unilateral contact with the skull: unlike in `Slide`, the brain can separate.

    Nodes with a normal in `Anatomy.slide_normal` stay on their side of a wall perpendicular to it, at an undeformed
    distance of `gap` [m]. The wall is curved as the normals around them; contact starts in the last 0.1 mm. Nodes in
    the craniotomy can rise through it, but touch bone beyond its edge, whose radius is set by the mesh size. The body
    needs fixed nodes of `Held`, since bone only limits its motion.

    The volume of the gap may pass the closed skull, see `Deformation.leaked`: 0.1 mm around a brain are 6 ml.

    Parameters
    ----------
    gap
        Undeformed distance between brain and bone [m].

    Raises
    ------
    InputError
        A gap that is not positive.
    """

    gap: float = 1e-4

    def __post_init__(self) -> None:
        check_gap("SkullContact", self.gap)


def check_gap(effect: str, gap: float) -> None:
    """Reject a gap [m] that is not positive."""
    if not 0.0 < gap < math.inf:
        raise InputError(f"{effect}.gap is {gap} m: give a positive number.")
