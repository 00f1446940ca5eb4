"""What covers part of the open cortex: squares of cotton that move with it, and a gloved finger."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ar.rendering.layer import Layer
from sim.geometry.surface import unit

from ..script.look import Cottonoid
from ..script.site import Site
from ..script.tool import capsule

COTTON, GLOVE = 5, 6
"""Segmentation ids."""
COTTON_COLOUR, GLOVE_COLOUR = (0.93, 0.92, 0.88), (0.86, 0.80, 0.66)
# Places along a side of a square; how far above the cortex it is drawn [m].
PLACES, THICK = 9, 0.7e-3
# A finger's radius and length, how far it reaches over the edge, and how high it is held [m].
FINGER, LENGTH, OVER, HIGH = 7e-3, 70e-3, 4e-3, 7e-3


@dataclass(frozen=True, eq=False)
class Squares:
    """Squares of cotton as places of the cortex: vertices and weights (n, 3), and triangles (m, 3) of the places."""

    vertices: np.ndarray
    weights: np.ndarray
    triangles: np.ndarray
    lift: np.ndarray

    def at(self, positions: np.ndarray) -> Layer:
        """As they lie when the mesh's vertices are at positions (V, 3) [m]."""
        carried = np.einsum("nk,nkd->nd", self.weights, positions[self.vertices])
        return Layer("cotton", COTTON, carried + self.lift, self.triangles, COTTON_COLOUR, gloss=0.1)


def squares(site: Site, cottonoids: Sequence[Cottonoid]) -> Squares:
    """Lay squares of cotton on an open cortex."""
    steps = np.linspace(-0.5, 0.5, PLACES)
    grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    i, j = (each.ravel() for each in np.meshgrid(*[np.arange(PLACES - 1)] * 2, indexing="ij"))
    a, b, c, d = (PLACES * (i + p) + j + q for p, q in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = np.concatenate([np.stack(each, axis=1) for each in ((a, b, c), (a, c, d))])
    places, triangles = [], []
    for each in cottonoids:
        turn = np.array([[np.cos(each.angle), -np.sin(each.angle)], [np.sin(each.angle), np.cos(each.angle)]])
        at = each.side * grid @ turn.T + (each.x, each.y)
        triangles.append(faces + len(places))
        places += [site.nearest(site.origin + x * site.right + y * site.up) for x, y in at]
    return Squares(
        np.array([place.vertices for place in places]), np.array([place.weights for place in places]),
        np.concatenate(triangles), -THICK * np.array([place.inward for place in places]),
    )  # fmt: skip


def finger(site: Site, angle: float) -> Layer:
    """A gloved finger that stands still over the edge of the opening, from a direction in the tangent plane [rad]."""
    out = np.cos(angle) * site.right + np.sin(angle) * site.up
    tip = site.origin + (site.clearance - OVER) * out - HIGH * site.axis
    way = unit((out - 0.35 * site.axis)[None])[0]
    side = unit(np.cross(way, site.axis)[None])[0]
    vertices, triangles = capsule(FINGER, LENGTH)
    turned = vertices @ np.stack([side, np.cross(way, side), way])
    return Layer("glove", GLOVE, turned + tip, triangles, GLOVE_COLOUR, gloss=0.3, still=True)
