"""A tool and a scene of one's own: a bent sucker, drawn as its own mesh, is laid on the cortex by its tip.

`sulcus demo sucker.py` plays it. Name an STL file in `Sucker(stl=...)` to see your own instrument.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import trimesh

from scenes import Scene, lay
from sim import Bonded, Core, Elasticity, Held, ToolContact

MM = 1e-3


@dataclass(frozen=True)
class Bent:
    """What of it touches tissue: an upright tube of a radius and a height [m], and a round foot across it."""

    radius: float
    height: float
    foot: float

    @property
    def cores(self) -> tuple[Core, ...]:
        """All within the radius of a line up the shaft, and of one along x. The lowest point is the origin."""
        up = Core(
            np.array([0.0, 0.0, self.radius + 0.5 * self.height]), np.array([0.0, 0.0, 0.5 * self.height]), self.radius
        )
        across = Core(np.array([0.5 * self.foot, 0.0, self.radius]), np.array([0.5 * self.foot, 0.0, 0.0]), self.radius)
        return up, across


@dataclass(frozen=True)
class Sucker:
    """A bent tube; `stl` is a file in millimetres, its tip at the origin and its shaft along +z, if there is one."""

    tube: float = 2.5 * MM
    height: float = 60.0 * MM
    foot: float = 6.0 * MM
    stl: str | None = None

    @property
    def radius(self) -> float:
        """The room that it needs in an opening [m]."""
        return self.tube + self.foot

    @property
    def shape(self) -> Bent:
        """What touches."""
        return Bent(self.tube, self.height, self.foot)

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """Its look: the file's, or one hull for each core."""
        if self.stl is not None:
            found = trimesh.load_mesh(Path(self.stl))
            found.apply_scale(MM)
            return found
        ball = trimesh.creation.icosphere(subdivisions=2, radius=self.tube).vertices
        hulls = [trimesh.convex.convex_hull((core.corners[:, None] + ball).reshape(-1, 3)) for core in self.shape.cores]
        found = trimesh.util.concatenate(hulls)
        assert isinstance(found, trimesh.Trimesh)
        return found

    def pose(self, tip: np.ndarray, inward: np.ndarray, aside: np.ndarray) -> np.ndarray:
        """T_world_tool (4, 4): upright on `tip` (3,) [m], its foot along `aside` (3,)."""
        T = np.eye(4)
        T[:3, :3] = np.column_stack([aside, np.cross(-inward, aside), -inward])
        T[:3, 3] = tip
        return T


SUCKER = Sucker()
SCENE = Scene(
    "sucker",
    __doc__ or "",
    lay(depth=4.0 * MM, rise=1.5),
    duration=3.0,
    effects=(Elasticity(), Held(), Bonded(), ToolContact((SUCKER.shape,))),
    tool=SUCKER,
)
