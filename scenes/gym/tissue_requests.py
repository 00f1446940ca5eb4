"""Requests to a tissue model in a step, and responses of the model."""

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
        Force (3,) [N] of the tool on the tissue.
    pressure
        Maximum pressure under the tool [Pa].
    reliable
        True if the solution is reliable.
    error
        95 % bound on the tumour vertex error relative to the model's FEM [m]; 0 for FEM.
    memory
        Solution from which the next solve starts; None: no such solution.
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
    """Request for the response of the tissue in one environment.

    Parameters
    ----------
    pose
        Pose T_world_tool (4, 4) [m] of the tool.
    previous
        Previous response; None at the start of an episode.
    fluid
        CSF level, from 0 (drained) to 1 (full).
    completed_steps
        Number of completed resection steps.
    """

    pose: np.ndarray
    previous: Response | None = None
    fluid: float = 1.0
    completed_steps: int = 0


class TissueModel(Protocol):
    """Protocol of a model of the tissue's response to tools: a trained model, or FEM.

    By default, all requests are solved in one batch on a GPU. On the CPU each request is solved alone, so that results
    do not depend on the number of requests.
    """

    def compute_responses(self, requests: Sequence[TissueRequest]) -> list[Response]:
        """Compute the responses to requests, in the order of the requests."""
        ...
