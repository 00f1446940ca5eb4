"""What is seen of the open cortex, and how far off it is: all that an estimate of the tumour's place is given."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.errors import InputError


@dataclass(frozen=True)
class Sight:
    """Points of the open cortex that are seen to move, with errors. Neither force nor tissue is known.

    What the tool hides is not seen. Where its tip touches the cortex, that place is seen too.

    Parameters
    ----------
    points
        How many, evenly by area inside the drape's hole; they stay the same in all frames.
    white, smooth
        Errors along each axis, as standard deviations [m]. The white one is another in each point and frame; the
        smooth one stays, and neighbours within 15 mm share it.
    shift, turn
        Size of the rigid error, which stays: a translation [m], and a rotation [rad] about the points' middle.
    seed
        From which points and errors are drawn: the same seed gives the same pictures.
    """

    points: int = 100
    white: float = 0.3e-3
    smooth: float = 0.5e-3
    shift: float = 0.7e-3
    turn: float = float(np.radians(0.3))
    seed: int = 0


@dataclass(frozen=True)
class StereoSight:
    """Points of the open cortex that both eyes of an operating microscope see, and that are followed.

    Its first pair of pictures shows the brain as the scan has it. Points are found in pictures: their depth by both
    eyes, their motion by the left one. The scan shows no vessels, so that some are drawn on the cortex.

    Parameters
    ----------
    points
        How many are looked for, evenly over the drape's hole.
    noise
        Of each eye's pictures, a standard deviation [grey level of 255]; it is another in each picture.
    darker
        What of the light the right eye lacks, from 0 to below 1.
    shift, turn
        Size of the rigid error of a tracked microscope: a translation [m], and a rotation [rad] about the middle of the
        opening. The first pair has one of its own; the other stays in all later ones.
    named
        Whether points are followed. If not, they are a cloud of the cortex, whose points have no places in the scan.
    vessels
        Whether vessels are drawn.
    seed
        From which vessels, noise and rigid errors are drawn: the same seed gives the same pictures.

    Raises
    ------
    InputError
        A light that is not from 0 to below 1, fewer than 6 points, or a size below 0.
    """

    points: int = 150
    noise: float = 2.0
    darker: float = 0.15
    shift: float = 0.7e-3
    turn: float = float(np.radians(0.3))
    named: bool = True
    vessels: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0.0 <= self.darker < 1.0:
            raise InputError(f"an eye lacks {self.darker} of its light: give a share from 0 to below 1.")
        if self.points < 6 or not min(self.noise, self.shift, self.turn, self.seed) >= 0:
            raise InputError("a pair of eyes sees 6 points at least; noise, shift, turn and seed are not below 0.")
