"""A box of which tissue is taken in two steps, for tests of what is left."""

import numpy as np
from boxes import base_held, box

from sim.accuracy import Accuracy
from sim.effects import Effect, Elasticity, Gravity, Held, Resection, ToolForce
from sim.geometry.tetmesh import TetMesh
from sim.loads import Loads, Posture, Resected
from sim.material import Material

TIGHT = Accuracy(tolerance=1e-11)
SOFT = Material("neo-hookean", 3000.0, 0.4)
MESH = box((3, 3, 3), 0.06, distortion=0.15)
BODY = base_held(MESH)
DOWN = np.array([0.0, 0.3, -1.0])


def within(low: tuple[float, float, float], high: tuple[float, float, float], mesh: TetMesh = MESH) -> tuple[int, ...]:
    """Tetrahedra whose middles lie in a box, in cubes' sides."""
    at = mesh.nodes[mesh.tets].mean(axis=1) / 0.02
    return tuple(np.flatnonzero(((at > low) & (at < high)).all(axis=1)).tolist())


TOP, NEXT = within((1, 1, 2), (2, 2, 4)), within((1, 1, 1), (2, 2, 2))
STEPS = Resection((TOP, NEXT))
EFFECTS: tuple[Effect, ...] = (Elasticity(SOFT), Held(), Gravity(direction=(0.0, 0.0, -1.0)), ToolForce())


def lying(done: np.ndarray | list[int], level: float = -1.0) -> Loads:
    """The head turned a little and drained, after so many steps."""
    rows = len(done)
    turned = Posture(np.tile(DOWN, (rows, 1)), np.full(rows, level), np.ones(rows))
    return Loads((turned, Resected(np.asarray(done))))
