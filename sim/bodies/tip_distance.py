"""How far the tip of a tool is from the tumour, both where they are in the deformed brain."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from ..anatomy import Anatomy
from ..errors import InputError
from ..geometry.ball_at_rest import find_resting_tips
from ..geometry.closest_point import find_closest_points
from ..loads import Loads, Pushed, Touching
from ..tools import BuiltIn, find_foremost_points
from .open_cortex import OpenCortex, open_cortex


@dataclass(frozen=True, eq=False)
class TipGauge:
    """Measures from the tip of a round tool to the closest point of the tumour's surface.

    A tool that pushes is a ball of its footprint's radius. It comes down along the open cortex's inward axis until it
    rests on the deformed open cortex. Its line goes through the point that it pushes, where the tissue has carried
    that. Its tip is its lowest point along that axis. Where poses are given, the tip is where they have it.

    Parameters
    ----------
    anatomy
        The body.
    together
        Cases whose tumours are looked at together: bounds the memory that it takes.

    Raises
    ------
    InputError
        An anatomy without open cortex.
    """

    anatomy: Anatomy
    together: int = 64

    @cached_property
    def cortex(self) -> OpenCortex:
        """The open cortex and its frame."""
        return open_cortex(self.anatomy)

    @cached_property
    def nodes(self) -> np.ndarray:
        """Sorted mesh vertices (n,) whose motion it needs: open cortex, and the tumour's surface."""
        return np.union1d(self._open[0], self._tumour[0])

    @cached_property
    def _open(self) -> tuple[np.ndarray, np.ndarray]:
        """Mesh vertices (m,) of the open cortex, and its triangles (S, 3) of them."""
        return np.unique(self.anatomy.open_surface, return_inverse=True)

    @cached_property
    def _tumour(self) -> tuple[np.ndarray, np.ndarray]:
        return np.unique(self.anatomy.tumour_surface, return_inverse=True)

    def distances(
        self,
        loads: Loads,
        displacement: np.ndarray,
        nodes: np.ndarray,
        tool: BuiltIn | None = None,
        lift: float = 0.0,
    ) -> np.ndarray:
        """Distances (B,) [m] from tip to tumour.

        Parameters
        ----------
        loads
            B pushes, or poses of one tool.
        displacement, nodes
            (B, n, 3) [m] of mesh vertices (n,), among them all of `self.nodes`.
        tool
            The one whose poses the loads are.
        lift
            How far [m] a tool that pushes has been lifted off, against the axis.

        Raises
        ------
        InputError
            Loads of another kind, poses of an unknown tool, vertices that are missing, an anatomy without
            tumour, or a ball that passes the open cortex by.
        """
        if not len(self.anatomy.tumour_nodes):
            raise InputError("the anatomy has no tumour, from which a tip had a distance: make one that has.")
        row = np.full(len(self.anatomy.mesh.nodes), -1)
        row[nodes] = np.arange(len(nodes))
        if (row[self.nodes] < 0).any():
            raise InputError(
                f"the distance from tip to tumour needs vertex {self.nodes[row[self.nodes] < 0][0]}, which this answer "
                "does not know: ask for the open cortex and the tumour."
            )
        tips = self._tips(loads, displacement, row[self._open[0]], tool, lift)
        found, at = np.empty(len(loads)), row[self._tumour[0]]
        for first in range(0, len(loads), self.together):
            some = slice(first, first + self.together)
            tumour = self.anatomy.mesh.nodes[self._tumour[0]] + displacement[some][:, at]
            near = find_closest_points(tips[some], tumour[:, self._tumour[1]]).point
            found[some] = np.linalg.norm(near - tips[some], axis=1)
        return found

    def _tips(
        self, loads: Loads, displacement: np.ndarray, row: np.ndarray, tool: BuiltIn | None, lift: float
    ) -> np.ndarray:
        """Of the tool (B, 3) [m]; `row` (m,) of the open cortex's vertices in `displacement`."""
        axis, touching = self.cortex.axis, loads.of(Touching)
        if touching is not None and tool is not None:
            return find_foremost_points(tool, touching.pose[:, 0], axis)
        pushed = loads.of(Pushed)
        if pushed is None:
            raise InputError("there is no tip where no tool pushes, and no known tool is moved.")
        nodes, triangles = self._open
        rest, tips = self.anatomy.mesh.nodes[nodes], np.empty((len(loads), 3))
        for first in range(0, len(loads), self.together):
            some = slice(first, first + self.together)
            _, triangle, weights = find_closest_points(pushed.point[some], rest[triangles])
            surface = rest + displacement[some][:, row]
            corners = surface[np.arange(len(surface))[:, None], triangles[triangle]]
            through = np.einsum("bc,bci->bi", weights, corners)
            tips[some] = find_resting_tips(surface, triangles, through, axis, pushed.footprint[some])
        return tips - lift * axis


@lru_cache(8)
def build_tip_gauge(anatomy: Anatomy) -> TipGauge:
    """Return the gauge of an anatomy; every frame asks for it."""
    return TipGauge(anatomy)
