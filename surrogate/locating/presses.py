"""What forces on the open cortex do: the shapes of a tool that nobody measured."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from sim.accuracy import Accuracy
from sim.anatomy import Anatomy
from sim.effects import SKULLS, Held, ToolForce
from sim.fem import Fem
from sim.loads import Loads, Pushed

from .causes import SPREAD, linear
from .regions import Region, beside

# Points of the open cortex, and tissues: Poisson's ratio of the brain, tumour stiffness over the brain's.
POINTS, TISSUES = 70, ((0.45, 2.0), (0.49, 0.7))
ACCURACY = Accuracy(tolerance=1e-3)


@dataclass(frozen=True, eq=False)
class Presses:
    """Motions by forces of one size.

    Parameters
    ----------
    points
        (p, 3) [m] of the open cortex.
    motion
        By name of the skull: (tissues, p, 3, V, 3) float32 [m], by a force along each axis.
    """

    points: np.ndarray
    motion: dict[str, np.ndarray]


def pressed(
    anatomy: Anatomy, skulls: tuple[str, ...], device: str = "auto", regions: tuple[Region, ...] = ()
) -> Presses:
    """Solve linear tissue under forces of 0.01 N, spread over 7 mm, in each of some skulls, with known `regions`."""
    nodes = anatomy.mesh.nodes[np.unique(anatomy.open_surface)]
    points = nodes[spaced(nodes, POINTS)]
    force = np.tile(0.01 * np.eye(3), (len(points), 1))
    loads = Loads((Pushed(np.repeat(points, 3, axis=0), force, np.full(len(force), SPREAD)),))
    found: dict[str, list[np.ndarray]] = {name: [] for name in skulls}
    for name, (poisson, ratio) in product(skulls, TISSUES):
        effects = (beside(linear, poisson, ratio, regions), Held(), SKULLS[name], ToolForce())
        motion = Fem(anatomy, effects, ACCURACY, device).deform(loads).displacement
        found[name].append(motion.reshape(len(points), 3, -1, 3).astype(np.float32))
    return Presses(points, {name: np.stack(parts) for name, parts in found.items()})


def spaced(points: np.ndarray, count: int) -> np.ndarray:
    """Numbers of `count` of the points (n, 3), each as far as can be from those before."""
    found = [int(((points - points.mean(axis=0)) ** 2).sum(axis=1).argmin())]
    away = np.full(len(points), np.inf)
    while len(found) < min(count, len(points)):
        away = np.minimum(away, ((points - points[found[-1]]) ** 2).sum(axis=1))
        found.append(int(away.argmax()))
    return np.array(found)
