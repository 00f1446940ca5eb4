"""What is asked of tissue in a step, and what it answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sim.deformation import Deformation


@dataclass(frozen=True, eq=False)
class Touched:
    """Where tissue is under a tool, and what the tool does to it.

    Parameters
    ----------
    motion, nodes
        (n, 3) [m] of mesh vertices (n,).
    force
        That the tool exerts on the tissue (3,) [N].
    pressure
        The highest under the tool [Pa].
    good
        Whether an answer was found that may be relied on.
    error
        In 95 of 100 loads no tumour vertex is farther from where the model's finite elements have it [m]; 0 of these
        themselves.
    memory
        What the next answer starts from.
    """

    motion: np.ndarray
    nodes: np.ndarray
    force: np.ndarray
    pressure: float
    good: bool = True
    error: float = 0.0
    memory: Deformation | None = None


@dataclass(frozen=True, eq=False)
class Asked:
    """What happens to the tissue of one environment.

    Parameters
    ----------
    pose
        T_world_tool (4, 4).
    last
        The answer before; None as an episode begins.
    fluid
        Share of its height at which the fluid stands.
    done
        Steps of a resection that are done.
    """

    pose: np.ndarray
    last: Touched | None = None
    fluid: float = 1.0
    done: int = 0


class Answers(Protocol):
    """Whatever answers tools with tissue: a trained model, or finite elements.

    On a card all that is asked is answered together. On the CPU each is answered apart, so that answers are the same
    byte for byte, however many are asked.
    """

    def answer(self, asked: Sequence[Asked]) -> list[Touched]:
        """Answer what is asked, in its order."""
        ...
