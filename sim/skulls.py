"""Descriptions of the contact models between brain and skull."""

import math
from dataclasses import dataclass

from .errors import InputError


@dataclass(frozen=True)
class Bonded:
    """Brain bonded to the skull by the meninges: nodes with a normal in `Anatomy.slide_normal` do not move.

    This is the stiff limit of an elastic layer. In the default brain, a layer of 0.1 kPa shear per mm moves the tumour
    2 % more. The measured layer is stiffer, 11 MPa per mm in compression (Mazumder et al. 2013, Acta Bioeng. Biomech.
    15(2):3-11). The model is valid while `Deformation.bond`, the largest ratio of traction to strength, is below 1.
    `Slide` and `SkullContact` are the frictionless limits.

    Parameters
    ----------
    tension, shear
        Tensile and shear strength [Pa]. The defaults are minima measured on sheep, 2.8 to 3.4 kPa and 1.8 to 2.1 kPa
        (Arzemanzadeh, Miller, Rosenow, Vos, Wittek 2025, arXiv 2512.08425).

    Raises
    ------
    InputError
        A strength is not positive.
    """

    tension: float = 2.8e3
    shear: float = 1.8e3

    def __post_init__(self) -> None:
        for name, value in (("tension", self.tension), ("shear", self.shear)):
            if not 0.0 < value < math.inf:
                raise InputError(f"Bonded.{name} is {value} Pa: give a positive number.")


@dataclass(frozen=True)
class Slide:
    """Frictionless sliding: nodes with a normal in `Anatomy.slide_normal` move only perpendicular to this normal.

    The tissue does not separate from the wall, which has no shear resistance. Undulations of the wall obstruct sliding
    tissue, so the motion of a deep tumour depends on the smoothness of the surface.
    """


@dataclass(frozen=True)
class SkullContact:
    """Frictionless unilateral contact with the skull: unlike in `Slide`, the brain can separate.

    Nodes with a normal in `Anatomy.slide_normal` stay inside a wall that is perpendicular to the normal, at a distance
    of `gap` [m] in the undeformed state. The normals around a node define the curvature of the wall. Contact starts in
    the last 0.1 mm. Nodes in the craniotomy can rise through the opening, but touch bone beyond its edge, whose radius
    depends on the mesh size. The effect `Held` must fix some nodes, since bone only limits the motion.

    `Deformation.leaked` includes the volume of the gap: a gap of 0.1 mm around a brain has 6 ml.

    Parameters
    ----------
    gap
        Distance between brain and bone in the undeformed state [m].

    Raises
    ------
    InputError
        The gap is not positive.
    """

    gap: float = 1e-4

    def __post_init__(self) -> None:
        check_gap("SkullContact", self.gap)


def check_gap(effect: str, gap: float) -> None:
    """Reject a `gap` [m] that is not positive; `effect` is the name of the effect in the message."""
    if not 0.0 < gap < math.inf:
        raise InputError(f"{effect}.gap is {gap} m: give a positive number.")
