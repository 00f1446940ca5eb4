"""What is seen of the open cortex, and how far off it is: all that an estimate of the tumour's place is given."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


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
