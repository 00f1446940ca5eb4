"""Contact over the product of skulls, tools, stiffness ratios, time steps and elements, on a small block."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from boxes import box
from test_sim_contact_hard import YIELDS, at, lattice

from sim.accuracy import TRAIN
from sim.anatomy import BRAIN_LABEL, TUMOUR_LABEL, Anatomy
from sim.deformation import Outcome
from sim.effects import Bonded, Effect, Elasticity, Held, Inertia, SkullContact, Slide, ToolContact
from sim.elements import ELEMENTS
from sim.fem import Fem
from sim.geometry.tetmesh import TetMesh
from sim.loads import Loads, Touching
from sim.material import Material
from sim.tools import Ball, Capsule, Spatula, Tool, core_of, distances_to

SIDE, DEPTH, GAP = 0.06, 2e-3, 1e-4
TURNED = (90.0, 0.0, 0.0)
SHAPES: dict[str, tuple[Tool, tuple[float, float, float]]] = {
    "ball": (Ball(6e-3), (0.0, 0.0, 0.0)),
    "rod on its side": (Capsule(3e-3, 8e-3), TURNED),
    "blade": (Spatula(0.012, 0.016, 1.5e-3), (0.0, 0.0, 0.0)),
    "blade on its edge": (Spatula(0.012, 0.016, 1e-3), TURNED),
}
SKULLS: dict[str, Effect] = {"bonded": Bonded(), "slide": Slide(), "contact": SkullContact(GAP)}
# Places of tools: within the opening, and 2 mm from the bone at x = 6 mm.
CENTRE, EDGE = 0.03, 8e-3


def block(ratio: bool) -> Anatomy:
    """A block on a fixed base whose top is open for 12 mm < x < 48 mm; with a tumour in its middle."""
    mesh = box((10, 4, 3), SIDE)
    inner = np.abs(mesh.nodes[mesh.tets].mean(axis=1) - mesh.nodes.mean(axis=0)).max(axis=1) < 0.01
    mesh = TetMesh(mesh.nodes, mesh.tets, np.where(inner & ratio, TUMOUR_LABEL, BRAIN_LABEL))
    x, _, z = mesh.nodes.T
    top = z > z.max() - 1e-9
    opened = top & (np.abs(x - 0.03) < 0.0181)
    normal = np.where((top & ~opened)[:, None], [0.0, 0.0, 1.0], 0.0)
    return Anatomy(mesh, np.repeat((z < 1e-9)[:, None], 3, axis=1), normal, opened)


def laid(tool: Tool, turn: tuple[float, float, float], x: float, top: float) -> np.ndarray:
    """T_world_tool (4, 4) of a tool whose lowest point is `DEPTH` under the top at x."""
    core, pose = core_of(tool), at(x, 0.012, top - DEPTH, turn=turn)  # type: ignore[arg-type]
    pose[2, 3] -= (core.corners @ pose[:3, :3].T)[:, 2].min() - core.radius
    return pose


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("skull", SKULLS)
def test_contact_product_ends_outside_or_says_so(skull: str, element: str) -> None:
    """A good outcome has no surface inside a tool and no inverted tetrahedron; none is good on bone."""
    for (name, (tool, turn)), ratio, step in product(SHAPES.items(), (1.0, 10.0), (None, 0.02)):
        anatomy = block(ratio != 1.0)
        top = float(anatomy.mesh.nodes[:, 2].max())
        tissue = Elasticity(
            Material("neo-hookean", 3000.0, 0.45), {TUMOUR_LABEL: Material("neo-hookean", 3000.0 * ratio, 0.45)}
        ) if ratio != 1.0 else Elasticity(Material("neo-hookean", 3000.0, 0.45))  # fmt: skip
        effects = [tissue, Held(), SKULLS[skull], ToolContact((tool,), GAP), *([] if step is None else [Inertia()])]
        fem = Fem(anatomy, effects, TRAIN, "cpu", element=element)
        poses = np.stack([laid(tool, turn, x, top) for x in (CENTRE, EDGE)])
        loads = Loads((Touching(poses[:, None]),), np.full(2, step or 0.0))
        found = fem.deform(loads)
        where = f"{name}, ratio {ratio}, step {step}"
        assert np.isfinite(found.displacement).all() and np.isfinite(found.reaction).all(), where
        bone = anatomy.mesh.surface[
            (anatomy.held.all(axis=1) | anatomy.slide_normal.any(axis=1))[anatomy.mesh.surface].all(axis=1)
        ]
        share = np.array([(i, j, 12 - i - j) for i in range(13) for j in range(13 - i)]) / 12.0
        solid = np.einsum("qc,scx->sqx", share, anatomy.mesh.nodes[bone]).reshape(-1, 3)
        for row, pose in enumerate(poses):
            if distances_to(tool, pose, solid).min() < -3.0 * GAP:
                assert found.outcome[row] is Outcome.ON_BONE, where
            if found.outcome[row].good:
                assert found.inverted[row] == 0, where
                points = (
                    lattice(anatomy, found, row)
                    if element != "p2"
                    else (anatomy.mesh.nodes + found.displacement[row])[anatomy.mesh.surface].reshape(-1, 3)
                )
                assert distances_to(tool, pose, points).min() > -(YIELDS + 0.5) * GAP, where
                assert found.reaction[row, 0, 2] < 0.0, where
                assert found.iterations[row] <= TRAIN.most, where
        assert found.outcome[0].good, f"{where}: {found.outcome[0]}"
        assert found.outcome[1] is Outcome.ON_BONE, where
