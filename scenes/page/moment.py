"""What a page shows now, and what is known of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ar.overlay.styles import Style

from ..play.player import Frame
from .referee import Truth
from .verdict import Judged


@dataclass
class Moment:
    """What the page shows now: the wish, its answer, the frame, and what the finite elements said of it.

    `goal` is the wish that the frame is on the way to, `asked` the one that it answers, `look` how that is shown.
    """

    goal: tuple | None = None
    asked: tuple | None = None
    shown: Truth | None = None
    rests: bool = False
    look: tuple[Style, str, str] | None = None
    load: str = ""
    frame: Frame | None = None
    picture: np.ndarray | None = None
    truth: Truth | None = None
    own: Truth | None = None
    by: tuple | None = None
    judged: Judged | None = None
    stale: bool | None = None
    plan: tuple[str, ...] | None = None
