"""Tissue response to a tool with prescribed pose, predicted by models trained on forces or on tool poses."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sim.errors import InputError
from sim.geometry.closest_point import find_closest_points
from sim.loads import Loads, Pushed, Touching
from sim.material import Tissue
from sim.tools import Ball
from surrogate.data.cortex_patch import Patch, open_patch
from surrogate.data.indentation import to_indentation
from surrogate.model.guarded import compute_tool_pressure
from surrogate.model.learned import Learned

from ..script.craniotomy_frame import CraniotomyFrame
from .tissue_requests import Response, TissueRequest

DEPTH_TOLERANCE = 1e-5  # Tolerance of the ball's depth [m].
MAX_ITERATIONS = 12  # Maximum number of iterations for the ball's depth.
MAX_FORCE_RATIO = 1.5  # Largest force in the search, relative to the strongest of the training.


@dataclass(frozen=True)
class Hertz:
    """Hertz contact model of a frictionless ball: forces, depths and pressures.

    Parameters
    ----------
    radius
        Radius of the ball [m].
    tissue
        Tissue of the half-space, of which only the stiffness at small strain is used.
    """

    radius: float
    tissue: Tissue

    @cached_property
    def modulus(self) -> float:
        """Plane-strain modulus E' = E / (1 - nu^2) = 2 mu / (1 - nu) [Pa]."""
        mu, lame = self.tissue.lame
        return 2.0 * mu / (1.0 - 0.5 * lame / (lame + mu))

    def compute_force(self, depth: np.ndarray) -> np.ndarray:
        """Return forces [N] at depths [m]: F = 4/3 E' sqrt(r) d^1.5; 0 above the surface."""
        return 4.0 / 3.0 * self.modulus * np.sqrt(self.radius) * np.maximum(depth, 0.0) ** 1.5

    def compute_contact_radius(self, force: np.ndarray) -> np.ndarray:
        """Return the contact radii [m] under forces [N]: a^3 = 3 F r / (4 E')."""
        return np.cbrt(0.75 * force * self.radius / self.modulus)

    def compute_pressure(self, force: float) -> float:
        """Return the maximum contact pressure [Pa], which is at the centre, under a force [N]: 3 F / (2 pi a^2)."""
        return 1.5 * force / (np.pi * float(self.compute_contact_radius(np.array(force))) ** 2) if force > 0.0 else 0.0

    def compute_extra_depth(self, force: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        """Return how much deeper (k,) [m] the ball sinks than a wider footprint (k,) [m] under equal forces (k,) [N].

        The centre of a footprint with pressure proportional to sqrt(1 - (s/a)^2) sinks by 3 F / (4 E' a).
        """
        own = np.where(force > 0.0, self.compute_contact_radius(force), 1.0)
        return 0.75 * force / self.modulus * (1.0 / own - 1.0 / footprint)


@dataclass(frozen=True, eq=False)
class PushSurrogate:
    """Model trained on forces, with a search for the force under which the predicted cortex touches the ball.

    The force acts at the point of the undeformed cortex that is nearest to the ball's centre, away from the centre. The
    footprint has the contact radius of `Hertz`. If the model was trained only on wider footprints, the depth is
    corrected by `Hertz.compute_extra_depth`.

    Parameters
    ----------
    site
        Craniotomy of the anatomy.
    model
        Model trained on pushes.
    ball
        Hertz model of the tool on the model's tissue.
    batched
        True if all environments are predicted in one batch.
    """

    site: CraniotomyFrame
    model: Learned
    ball: Hertz
    batched: bool = False

    @cached_property
    def _patch(self) -> Patch:
        return open_patch(self.site.anatomy)

    def compute_responses(self, requests: Sequence[TissueRequest]) -> list[Response]:
        """Predict responses, see `TissueModel.compute_responses`."""
        poses = np.stack([each.pose for each in requests])
        parts = [poses] if self.batched else np.split(poses, len(poses))
        return [touched for part in parts for touched in self._predict_poses(part)]

    def _predict_poses(self, poses: np.ndarray) -> list[Response]:
        """Predict the responses to tools at poses (B, 4, 4) in one batch."""
        near = to_indentation(Loads((Touching(poses[:, None]),)), Ball(self.ball.radius), self._patch)
        depth = np.linalg.norm(near.force, axis=1)
        inward = np.divide(near.force, depth[:, None], out=np.zeros_like(near.force), where=depth[:, None] > 0.0)
        answers = [Response(np.zeros((len(self.model.nodes), 3)), self.model.nodes, np.zeros(3), 0.0) for _ in poses]
        rows = np.flatnonzero(depth > 0.0)
        if not len(rows):
            return answers
        point, inward = near.point[rows], inward[rows]
        size, found = self._find_forces(point, inward, depth[rows])
        result = self.model.deform(self._build_loads(point, inward, size))
        stated = np.where(np.isfinite(result.bound[0]), result.bound[0], self.model.bound)
        for number, row in enumerate(rows.tolist()):
            answers[row] = Response(
                result.displacement[number], result.nodes, size[number] * inward[number],
                self.ball.compute_pressure(float(size[number])), bool(found[number]), float(stated[number]),
            )  # fmt: skip
        return answers

    def _build_loads(self, point: np.ndarray, inward: np.ndarray, force: np.ndarray) -> Loads:
        """Build pushes of sizes (k,) [N]; footprints have the contact radius, clipped to the training range."""
        return Loads((Pushed(point, force[:, None] * inward, self._compute_footprint(force)),))

    def _compute_footprint(self, force: np.ndarray) -> np.ndarray:
        return np.clip(self.ball.compute_contact_radius(force), *self.model.envelope.footprint)

    def _find_forces(self, point: np.ndarray, inward: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find forces (k,) [N] at points (k, 3) by the secant method; also return True (k,) if the depth is reached."""
        patch, rows = self._patch, np.arange(len(depth))
        place = find_closest_points(point, patch.points[patch.triangles])
        corners, most = patch.triangles[place.triangle], MAX_FORCE_RATIO * self.model.envelope.force[1]

        def compute_depth_error(force: np.ndarray) -> np.ndarray:
            """Return the signed depth error (k,) [m] of the ball under each trial force."""
            moved = self.model.deform(self._build_loads(point, inward, force), at=patch.nodes).displacement
            there = np.einsum("kc,kci,ki->k", place.weights, moved[rows[:, None], corners], inward)
            return there + self.ball.compute_extra_depth(force, self._compute_footprint(force)) - depth

        before, short = np.zeros(len(depth)), -depth
        size = np.minimum(self.ball.compute_force(depth), most)
        for _ in range(MAX_ITERATIONS):
            now = compute_depth_error(size)
            near = np.abs(now) < DEPTH_TOLERANCE
            if near.all():
                break
            slope = np.where(near, np.inf, now - short) / np.where(near | (size == before), 1.0, size - before)
            # Converged entries keep their force, so that others in the batch have no influence.
            before, short, size = size, now, np.where(near, size, np.clip(size - now / slope, 0.0, most))
        return size, np.abs(compute_depth_error(size)) < DEPTH_TOLERANCE


@dataclass(frozen=True, eq=False)
class PoseSurrogate:
    """Model trained on tool poses, which predicts motion, force and error bound; a solution starts from the last.

    The pressure under a ball follows from its force by `Hertz`; under a blade it is the maximum of
    `compute_tool_pressure`.

    Parameters
    ----------
    model
        Model trained on poses of the tool.
    ball
        Hertz model of the tool; None if the tool is not a ball.
    """

    model: Learned
    ball: Hertz | None

    def compute_responses(self, requests: Sequence[TissueRequest]) -> list[Response]:
        """Predict responses one by one, see `TissueModel.compute_responses`.

        If the model rejects a pose, the response is the previous response, marked as unreliable.
        """
        return [self._predict_pose(each.pose, each.previous) for each in requests]

    def _predict_pose(self, pose: np.ndarray, previous: Response | None) -> Response:
        loads = Loads((Touching(pose[None, None]),))
        try:
            result = self.model.deform(loads, None if previous is None else previous.memory)
        except InputError:
            nodes = self.model.nodes
            rest = Response(np.zeros((len(nodes), 3)), nodes, np.zeros(3), 0.0) if previous is None else previous
            return replace(rest, reliable=False, error=float("inf"))
        force = result.reaction[0, 0, :3]
        if self.ball is None:
            highest = float(compute_tool_pressure(self.model, loads, result).max())
        else:
            highest = self.ball.compute_pressure(float(np.linalg.norm(force)))
        error = float(result.bound[0, 0])
        if not np.isfinite(error):
            error = self.model.bound
        return Response(result.displacement[0], result.nodes, force, highest, error=error, memory=result)
