"""Contact over the product of skulls, tools, stiffness ratios, time steps and elements, on a small block."""

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
from sim.tools import Ball, Capsule, Spatula, Tool, compute_distances, get_core

SIDE, DEPTH, GAP = 0.06, 1.5e-3, 1e-4
TURNED = (90.0, 0.0, 0.0)
SHAPES: dict[str, tuple[Tool, tuple[float, float, float]]] = {
    "ball": (Ball(6e-3), (0.0, 0.0, 0.0)),
    "rod on its side": (Capsule(3e-3, 8e-3), TURNED),
    "blade": (Spatula(9e-3, 0.012, 1.5e-3), (0.0, 0.0, 0.0)),
    "blade on its edge": (Spatula(9e-3, 0.012, 1e-3), TURNED),
}
TOOLS = tuple(tool for tool, _ in SHAPES.values())
SKULLS: dict[str, Effect] = {"bonded": Bonded(), "slide": Slide(), "contact": SkullContact(GAP)}
# Places of tools: within the opening, and 2 mm from the bone at x = 6 mm. The tools of other cases stay in the air.
CENTRE, EDGE = 0.03, 8e-3
CASES = tuple(product(SHAPES, (CENTRE, EDGE)))
AWAY = at(0.03, 0.012, 1.0)


def block(ratio: bool) -> Anatomy:
    """A block on a fixed base whose top is open for 12 mm < x < 48 mm; with a tumour in its middle."""
    mesh = box((10, 4, 2), SIDE)
    inner = np.abs(mesh.nodes[mesh.tets].mean(axis=1) - mesh.nodes.mean(axis=0)).max(axis=1) < 0.01
    mesh = TetMesh(mesh.nodes, mesh.tets, np.where(inner & ratio, TUMOUR_LABEL, BRAIN_LABEL))
    x, _, z = mesh.nodes.T
    top = z > z.max() - 1e-9
    opened = top & (np.abs(x - 0.03) < 0.0181)
    normal = np.where((top & ~opened)[:, None], [0.0, 0.0, 1.0], 0.0)
    return Anatomy(mesh, np.repeat((z < 1e-9)[:, None], 3, axis=1), normal, opened)


def laid(shape: str, x: float, top: float) -> np.ndarray:
    """T_world_tool (4, 4) of a tool whose lowest point is `DEPTH` under the top at x."""
    tool, turn = SHAPES[shape]
    core, pose = get_core(tool), at(x, 0.012, top - DEPTH, turn=turn)  # type: ignore[arg-type]
    pose[2, 3] -= (core.corners @ pose[:3, :3].T)[:, 2].min() - core.radius
    return pose


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("skull", SKULLS)
def test_contact_ends_without_penetration_or_reports_failure(skull: str, element: str) -> None:
    """A good outcome has no surface inside a tool and no inverted tetrahedron; a tool on bone has no good outcome."""
    for ratio, step in product((1.0, 10.0), (None, 0.02)):
        anatomy = block(ratio != 1.0)
        soft, stiff = (Material("neo-hookean", 3000.0 * times, 0.45) for times in (1.0, ratio))
        tissue = Elasticity(soft) if ratio == 1.0 else Elasticity(soft, {TUMOUR_LABEL: stiff})
        effects = [tissue, Held(), SKULLS[skull], ToolContact(TOOLS, GAP), *([] if step is None else [Inertia()])]
        top = float(anatomy.mesh.nodes[:, 2].max())
        poses = np.array([[laid(name, x, top) if name == shape else AWAY for name in SHAPES] for shape, x in CASES])
        fem = Fem(anatomy, effects, TRAIN, "cpu", element=element)
        found = fem.deform(Loads((Touching(poses),), np.full(len(CASES), step or 0.0)))
        assert np.isfinite(found.displacement).all() and np.isfinite(found.reaction).all()
        bone = anatomy.mesh.surface[
            (anatomy.fixed.all(axis=1) | anatomy.slide_normal.any(axis=1))[anatomy.mesh.surface].all(axis=1)
        ]
        share = np.array([(i, j, 12 - i - j) for i in range(13) for j in range(13 - i)]) / 12.0
        solid = np.einsum("qc,scx->sqx", share, anatomy.mesh.nodes[bone]).reshape(-1, 3)
        for row, (shape, x) in enumerate(CASES):
            where = f"{shape} at {x}, ratio {ratio}, step {step}: {found.outcome[row]}"
            tool, pose = SHAPES[shape][0], laid(shape, x, top)
            assert found.outcome[row].good == (x == CENTRE), where
            assert (found.outcome[row] is Outcome.ON_BONE) == (x == EDGE), where
            assert (compute_distances(tool, pose, solid).min() < -3.0 * GAP) == (x == EDGE), where
            if found.outcome[row].good:
                assert found.inverted[row] == 0, where
                points = (
                    lattice(anatomy, found, row)
                    if element != "p2"
                    else (anatomy.mesh.nodes + found.displacement[row])[anatomy.mesh.surface].reshape(-1, 3)
                )
                assert compute_distances(tool, pose, points).min() > -(YIELDS + 0.5) * GAP, where
                assert found.reaction[row, TOOLS.index(tool), 2] < 0.0, where
                assert found.iterations[row] <= TRAIN.most, where
