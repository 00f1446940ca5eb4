"""Tools in a block, for the conformance suite of terms."""

import numpy as np
from scipy.spatial.transform import Rotation
from term_examples import ANATOMY, MESH, Example

from sim.compile import compile_problem
from sim.discretisation.space import discretise
from sim.discretisation.term import Cases, Term
from sim.effects import Elasticity, Held, Retraction, ToolContact
from sim.loads import Loads, Retracted, Touching
from sim.runtime.device import Device
from sim.tools import Ball, Capsule, Spatula, Tool

# On the block's top, tilted into it, and in its side.
POSES = np.tile(np.eye(4), (3, 1, 1))
POSES[:, :3, :3] = Rotation.from_euler("xyz", [[0.0, 0.0, 0.3], [0.4, -0.3, 0.2], [0.1, 1.5, 0.0]]).as_matrix()
POSES[:, :3, 3] = [[0.045, 0.055, 0.094], [0.06, 0.04, 0.091], [0.094, 0.03, 0.055]]
BLADE = Spatula(0.03, 0.05, 4e-3)


def touching(*tools: Tool, element: str = "p1") -> Example:
    """Rigid tools in the block, each a little beside the one before."""
    space, gap = discretise(MESH, element), 0.06
    pose = np.repeat(POSES[:, None], len(tools), axis=1)
    pose[:, :, 0, 3] += 0.02 * np.arange(len(tools))

    def build(device: Device) -> Term:
        effects = (Elasticity(), Held(), ToolContact(tools, gap))
        return compile_problem(effects, ANATOMY, device, space).terms[-1]

    return Example(build, Cases(Loads((Touching(pose),)), np.zeros(3)), walled=True, nodes=space.nodes)


def retracted() -> Example:
    """A blade laid on beside the block and drawn into it."""
    drawn = np.array([[0.0, 0.0, -0.02], [0.01, 0.0, -0.02], [-0.03, 0.0, 0.0]])
    laid = POSES.copy()
    laid[:, :3, 3] -= drawn

    def build(device: Device) -> Term:
        effects = (Elasticity(), Held(), Retraction(BLADE, 0.03))
        return compile_problem(effects, ANATOMY, device).terms[-1]

    return Example(build, Cases(Loads((Retracted(laid, drawn),)), np.zeros(3)), walled=True)


CONTACTS = {
    "ball": touching(Ball(0.02)),
    "rod": touching(Capsule(0.01, 0.03)),
    "blade": touching(BLADE),
    "ball p2": touching(Ball(0.02), element="p2"),
    "two tools p2": touching(BLADE, Capsule(0.01, 0.03), element="p2"),
    "retraction": retracted(),
}
