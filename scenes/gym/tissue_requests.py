"""Request to a tissue model in a step, and its response."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sim.deformation import Deformation


@dataclass(frozen=True, eq=False)
class Response:
    """Response of the tissue to a tool.

    Parameters
    ----------
    motion, nodes
        Displacements (n, 3) [m] of mesh vertices (n,).
    force
        Force of the tool on the tissue (3,) [N].
    pressure
        Maximum pressure under the tool [Pa].
    reliable
        True if the solution is reliable.
    error
        95 % bound of the tumour vertex error relative to the model's FEM [m]; 0 for FEM itself.
    memory
        State from which the next solution starts.
    """

    motion: np.ndarray
    nodes: np.ndarray
    force: np.ndarray
    pressure: float
    reliable: bool = True
    error: float = 0.0
    memory: Deformation | None = None


@dataclass(frozen=True, eq=False)
class TissueRequest:
    """Load on the tissue of one environment.

    Parameters
    ----------
    pose
        T_world_tool (4, 4).
    previous
        Previous response; None at the start of an episode.
    fluid
        Fluid level relative to its full height.
    completed_steps
        Number of completed resection steps.
    """

    pose: np.ndarray
    previous: Response | None = None
    fluid: float = 1.0
    completed_steps: int = 0


class TissueModel(Protocol):
    """Model of the tissue's response to tools: trained, or FEM.

    On a GPU all requests are solved in one batch. On the CPU each is solved alone, so that results are the same byte
    for byte for any number of requests.
    """

    def compute_responses(self, requests: Sequence[TissueRequest]) -> list[Response]:
        """Compute the responses to requests, in their order."""
        ...
