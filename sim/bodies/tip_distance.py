"""Distance from the tip of a tool to the tumour in the deformed brain."""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from ..anatomy import Anatomy
from ..errors import InputError
from ..geometry.closest_point import find_closest_points
from ..geometry.first_contact import find_resting_tips
from ..loads import Loads, Pushed, Touching
from ..tools import BuiltIn, find_foremost_points
from .open_cortex import OpenCortex, open_cortex


@dataclass(frozen=True, eq=False)
class TipGauge:
    """Distance from the tip of a round tool to the nearest point of the tumour's surface.

    A pushing tool is a ball with the radius of its footprint. The ball is lowered along the inward axis of the exposed
    cortex, through the deformed position of the pushed point, until it touches the deformed surface. The tip is the
    lowest point of the ball along this axis. For loads with tool poses, the tip follows from the pose.

    Parameters
    ----------
    anatomy
        Anatomy with exposed cortex.
    block_size
        Number of load cases computed at once, which limits memory.

    Raises
    ------
    InputError
        The anatomy has no exposed cortex.
    """

    anatomy: Anatomy
    block_size: int = 64

    @cached_property
    def cortex(self) -> OpenCortex:
        """Exposed cortex, with its coordinate system."""
        return open_cortex(self.anatomy)

    @cached_property
    def nodes(self) -> np.ndarray:
        """Sorted mesh vertices (n,) whose displacement is required: exposed cortex and surface of the tumour."""
        return np.union1d(self._open_surface[0], self._tumour_surface[0])

    @cached_property
    def _open_surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Mesh vertices (m,) of the exposed cortex, and its triangles (S, 3) as indices into these vertices."""
        return np.unique(self.anatomy.open_surface, return_inverse=True)

    @cached_property
    def _tumour_surface(self) -> tuple[np.ndarray, np.ndarray]:
        return np.unique(self.anatomy.tumour_surface, return_inverse=True)

    def compute_distances(
        self, loads: Loads, displacement: np.ndarray, nodes: np.ndarray, tool: BuiltIn | None = None, lift: float = 0.0
    ) -> np.ndarray:
        """Return the distances (B,) [m] from the tip of the tool to the tumour.

        Parameters
        ----------
        loads
            B load cases of one pushing tool, or of one tool with given poses.
        displacement, nodes
            Displacements (B, n, 3) [m] of mesh vertices (n,), which include all of `self.nodes`.
        tool
            Tool to which the poses refer; not required for a pushing tool.
        lift
            Distance [m] by which a pushing tool has been retracted from the surface, against the axis.

        Raises
        ------
        InputError
            The loads are of another type, `tool` or vertices are missing, the anatomy has no tumour, or the ball misses
            the exposed cortex.
        """
        if not len(self.anatomy.tumour_nodes):
            raise InputError("the anatomy has no tumour: use one with a tumour to measure the distance of a tip.")
        row = np.full(len(self.anatomy.mesh.nodes), -1)
        row[nodes] = np.arange(len(nodes))
        if (row[self.nodes] < 0).any():
            raise InputError(
                f"the distance from tip to tumour needs vertex {self.nodes[row[self.nodes] < 0][0]}, which the "
                "displacements lack: request the open cortex and the tumour."
            )
        tips = self._compute_tips(loads, displacement, row[self._open_surface[0]], tool, lift)
        found, at = np.empty(len(loads)), row[self._tumour_surface[0]]
        for first in range(0, len(loads), self.block_size):
            some = slice(first, first + self.block_size)
            tumour = self.anatomy.mesh.nodes[self._tumour_surface[0]] + displacement[some][:, at]
            near = find_closest_points(tips[some], tumour[:, self._tumour_surface[1]]).point
            found[some] = np.linalg.norm(near - tips[some], axis=1)
        return found

    def _compute_tips(
        self, loads: Loads, displacement: np.ndarray, cortex_rows: np.ndarray, tool: BuiltIn | None, lift: float
    ) -> np.ndarray:
        """Return the tip positions (B, 3) [m]; `cortex_rows` (m,): those of the exposed cortex in `displacement`."""
        axis, touching = self.cortex.axis, loads.get(Touching)
        if touching is not None and tool is not None:
            return find_foremost_points(tool, touching.pose[:, 0], axis)
        pushed = loads.get(Pushed)
        if pushed is None:
            raise InputError("the loads have no tip: give pushing tools, or poses and their tool.")
        nodes, triangles = self._open_surface
        rest, tips = self.anatomy.mesh.nodes[nodes], np.empty((len(loads), 3))
        for first in range(0, len(loads), self.block_size):
            some = slice(first, first + self.block_size)
            _, triangle, weights = find_closest_points(pushed.point[some], rest[triangles])
            surface = rest + displacement[some][:, cortex_rows]
            corners = surface[np.arange(len(surface))[:, None], triangles[triangle]]
            through = np.einsum("bc,bci->bi", weights, corners)
            tips[some] = find_resting_tips(surface, triangles, through, axis, pushed.footprint[some])
        return tips - lift * axis


@lru_cache(8)
def build_tip_gauge(anatomy: Anatomy) -> TipGauge:
    """Return the gauge of an anatomy from a cache, since every frame uses the gauge."""
    return TipGauge(anatomy)
