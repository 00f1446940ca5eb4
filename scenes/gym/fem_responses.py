"""FEM response of the tissue to a tool with prescribed pose, and to drainage and resection."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from sim.contact_pressure import compute_pressure
from sim.deformation import Deformation, join_deformations
from sim.fem import Fem
from sim.geometry.closest_point import find_closest_points
from sim.geometry.surface import compute_vertex_normals
from sim.geometry.tetmesh import TetMesh
from sim.loads import Loads, Resected, Touching
from sim.resected_fem import ResectedFem

from ..script.craniotomy_frame import CraniotomyFrame
from ..script.head_pose import HeadPose
from .model_responses import Hertz
from .tissue_requests import Response, TissueRequest


@dataclass(frozen=True, eq=False)
class ContactFem:
    """FEM model of the contact with a rigid tool.

    The pressure under a ball follows by `Hertz`; under a blade it is the maximum of `compute_pressure`.

    Parameters
    ----------
    fem
        FEM with `ToolContact` of the tool.
    ball
        Hertz model of the tool; None if the tool is not a ball.
    batched
        True if all environments are solved in one batch.
    """

    fem: Fem
    ball: Hertz | None
    batched: bool = False

    def compute_responses(self, requests: Sequence[TissueRequest]) -> list[Response]:
        """Solve requests, see `TissueModel.compute_responses`; requests at an episode's start form a separate batch."""
        found: dict[int, Response] = {}
        begin = [row for row, each in enumerate(requests) if each.previous is None]
        going = [row for row, each in enumerate(requests) if each.previous is not None]
        for rows in (begin, going):
            for some in [rows] if self.batched and rows else [[row] for row in rows]:
                found |= dict(zip(some, self._solve_poses([requests[row] for row in some]), strict=True))
        return [found[row] for row in range(len(requests))]

    def _solve_poses(self, requests: Sequence[TissueRequest]) -> list[Response]:
        loads = Loads((Touching(np.stack([each.pose for each in requests])[:, None]),))
        starts = [each.previous.memory for each in requests if each.previous and each.previous.memory is not None]
        result = self.fem.deform(loads, join_deformations(starts) if len(starts) > 1 else next(iter(starts), None))
        force = result.reaction[:, 0, :3]
        size = np.linalg.norm(force, axis=1)
        if self.ball is not None:
            highest = [self.ball.compute_pressure(float(each)) for each in size]
        else:
            highest = compute_pressure(self.fem, loads, result).max(axis=1).tolist()
        rows = [result]
        if len(requests) > 1:
            rows = [replace(result.select(np.array([row])), warm={}) for row in range(len(requests))]
        return [
            Response(row.displacement[0], row.nodes, force[number], highest[number], row.outcome[0].good, memory=row)
            for number, row in enumerate(rows)
        ]


LEVEL_SPACING = (
    0.1  # Spacing of the solved fluid levels, relative to the height; solutions in between are interpolated.
)
MAX_SURFACE_DISTANCE = 0.03  # Distance from the corridor and the tumour within which healthy tissue is considered [m].


class RemainingSurface(NamedTuple):
    """Surface triangles (S, 3) of the remaining healthy tissue near the tumour, and outward normals (V, 3)."""

    triangles: np.ndarray
    normals: np.ndarray


@dataclass(frozen=True, eq=False)
class ResectionFem:
    """FEM model under gravity, by CSF level and number of resection steps; each state is solved once.

    The force of the ball on healthy tissue follows `Hertz`. The ball can enter the tumour, and moves no tissue.

    Parameters
    ----------
    site
        Craniotomy of the anatomy.
    fem
        FEM of the resection.
    ball
        Hertz model of the tool on brain tissue.
    """

    site: CraniotomyFrame
    fem: ResectedFem
    ball: Hertz
    _solved: dict[tuple[int, int], Deformation] = field(default_factory=dict)
    _surfaces: dict[int, RemainingSurface] = field(default_factory=dict)

    def compute_responses(self, requests: Sequence[TissueRequest]) -> list[Response]:
        """Solve requests, see `TissueModel.compute_responses`; results do not depend on earlier requests."""
        return [self._solve_request(each) for each in requests]

    def _solve_request(self, asked: TissueRequest) -> Response:
        level = (1.0 - asked.fluid) / LEVEL_SPACING
        low = int(level)
        share = level - low
        motion = self._solve_level(low, asked.completed_steps).displacement[0]
        if share > 0.0:
            motion = (1.0 - share) * motion + share * self._solve_level(low + 1, asked.completed_steps).displacement[0]
        force = self._compute_force(asked.pose, asked.completed_steps, motion)
        size = float(np.linalg.norm(force))
        levels = range(low, low + (2 if share > 0.0 else 1))
        good = all(self._solve_level(level, asked.completed_steps).outcome[0].good for level in levels)
        return Response(motion, np.arange(len(motion)), force, self.ball.compute_pressure(size), good)

    def _solve_level(self, level: int, completed_steps: int) -> Deformation:
        """Return the solution at a CSF level, whose solve starts from the solution at the level above.

        After several resection steps, the solve starts from the solution with one step less.
        """
        key = level, completed_steps
        if key not in self._solved:
            start = None
            if completed_steps > 1:
                start = self._solve_level(level, completed_steps - 1)
            elif level > 0:
                start = self._solve_level(level - 1, completed_steps)
            posture = HeadPose(fluid=1.0 - LEVEL_SPACING * level).build_posture(self.site.anatomy.mesh.nodes)
            self._solved[key] = self.fem.deform(Loads((posture, Resected(np.array([float(completed_steps)])))), start)
        return self._solved[key]

    def _compute_force(self, pose: np.ndarray, completed_steps: int, motion: np.ndarray) -> np.ndarray:
        """Compute the force (3,) [N] of the ball at a pose (4, 4) on healthy tissue."""
        healthy, nodes = self._get_surface(completed_steps), self.site.anatomy.mesh.nodes
        radius = self.ball.radius
        middle = pose[:3, 3] + radius * pose[:3, 2]
        near = find_closest_points(middle[None], (nodes + motion)[healthy.triangles])
        corners = healthy.triangles[near.triangle[0]]
        outward = near.weights[0] @ healthy.normals[corners]
        outward /= np.linalg.norm(outward)
        away = middle - near.point[0]
        distance = float(np.copysign(np.linalg.norm(away), away @ outward))
        return -float(self.ball.compute_force(np.array(radius - distance))) * outward

    def _get_surface(self, completed_steps: int) -> RemainingSurface:
        """Return the surface of the remaining healthy tissue after `completed_steps` resection steps."""
        if completed_steps not in self._surfaces:
            self._surfaces[completed_steps] = self._build_surface(completed_steps)
        return self._surfaces[completed_steps]

    def _build_surface(self, completed_steps: int) -> RemainingSurface:
        body = self.fem.get_remaining_body(completed_steps).anatomy
        left, brain = body.mesh, ~body.in_tumour
        surface = TetMesh(left.nodes, left.tets[brain], left.region[brain]).surface
        tumour = self.site.anatomy.tumour_nodes
        way = np.linspace(self.site.origin, left.nodes[tumour].mean(axis=0), 8)
        middle = left.nodes[surface].mean(axis=1)
        around = np.concatenate([way, left.nodes[tumour]])
        near = np.linalg.norm(middle[:, None] - around, axis=2).min(axis=1) < MAX_SURFACE_DISTANCE
        return RemainingSurface(surface[near], compute_vertex_normals(left.nodes, surface))
