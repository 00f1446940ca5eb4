"""Cases that break solvers, each with its usual failure and its required outcome.

Whatever is marked converged has its residual computed again from the published formulas, without the package.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from boxes import base_held, box, hold, quadratic, top_forces
from on_host import equilibrium_of
from oracle import EVERY_LAW, internal_forces, tissue

from sim.accuracy import TRAIN, Accuracy
from sim.anatomy import Anatomy
from sim.compile import compile_problem
from sim.deformation import Deformation, Outcome, build_start
from sim.discretisation.term import Cases
from sim.effects import Elasticity, Held, NodalForce
from sim.errors import InputError
from sim.fem import Fem
from sim.geometry.tetmesh import MeshWarning, TetMesh, compute_dihedral_angles
from sim.linalg.preconditioner import build_rest_solver
from sim.loads import Loads, Nodal
from sim.material import Material, Tissue
from sim.minimisers.newton_cg import NewtonCG
from sim.runtime.device import find_device
from sim.runtime.memory import check_fits, measure_host_bytes

TOLERANCE = 1e-7
ACCURACY = Accuracy(tolerance=TOLERANCE)
CONVERGED = {Outcome.CONVERGED, Outcome.CONVERGED_ANEW, Outcome.CONVERGED_IN_STEPS}
STOPPED = {Outcome.BUDGET, Outcome.STALLED, Outcome.ROUND_OFF}
ANEW = frozenset({Outcome.CONVERGED_ANEW})
BEYOND = {Outcome.OVERSTRAINED, Outcome.INVERTED}
ANYHOW = frozenset(CONVERGED | STOPPED | BEYOND)
PUSH = np.array([0.03, 0.02, -0.25])
BLOCK = box((3, 3, 5), 0.1, distortion=0.15)
SOFT = Material("stable-neo-hookean", 3000.0, 0.45)


@dataclass(frozen=True)
class Hard:
    """A static problem: body, tissues by region, nodal forces (V, 3) [N], and how it may end.

    It starts at rest, at `start` (V, 3) [m], or where other forces `after` (V, 3) [N] have left the block.
    """

    wrong_elsewhere: str
    mesh: TetMesh
    tissues: dict[int, Tissue]
    force: np.ndarray
    start: np.ndarray | None = None
    after: np.ndarray | None = None
    element: str | None = None
    ends: frozenset[Outcome] = frozenset(CONVERGED)
    held: np.ndarray | None = None
    accuracy: Accuracy = field(default=ACCURACY)

    @property
    def anatomy(self) -> Anatomy:
        return base_held(self.mesh) if self.held is None else hold(self.mesh, self.held)

    def solve(self) -> Deformation:
        first = next(iter(self.tissues.values()))
        fem = Fem(
            self.anatomy, [Elasticity(first, self.tissues), Held(), NodalForce()], self.accuracy, "cpu",
            element=self.element or ("p1" if self.mesh.middles is None else "p2"),
        )  # fmt: skip
        start = self.start if self.after is None else solved(self.after)
        return fem.deform(Loads((Nodal(self.force[None]),)), None if start is None else build_start(start[None]))

    def residual(self, u: np.ndarray) -> float:
        """Of the whole load at u (V, 3) [m], against the larger of the load and the internal forces."""
        free = ~self.anatomy.fixed
        inner = internal_forces(
            self.mesh, self.tissues, u, "p2" if self.mesh.middles is not None else self.element or "p1"
        )
        scale = max(np.linalg.norm(inner), np.linalg.norm(self.force))
        return float(np.linalg.norm((inner - self.force)[free]) / scale) if scale else 0.0


def pressed(mesh: TetMesh = BLOCK, push: np.ndarray = PUSH) -> np.ndarray:
    return top_forces(mesh, push)[0]


def soft(law: str, poisson: float = 0.45) -> dict[int, Tissue]:
    return {0: tissue(law, 3000.0, poisson)}


def included(stiff: float) -> tuple[TetMesh, dict[int, Tissue]]:
    """A core of another stiffness."""
    middle = np.abs(BLOCK.nodes[BLOCK.tets].mean(axis=1) - BLOCK.nodes.mean(axis=0)).max(axis=1) < 0.02
    mesh = TetMesh(BLOCK.nodes, BLOCK.tets, middle.astype(int))
    return mesh, {0: SOFT, 1: Material("stable-neo-hookean", 3000.0 * stiff, 0.45)}


def slivers() -> TetMesh:
    """Inner nodes pressed onto the plane of their neighbours: dihedral angles of a tenth of a degree."""
    mesh = box((3, 3, 3), 0.1)
    nodes = mesh.nodes.copy()
    inner = np.flatnonzero(((nodes > 1e-6) & (nodes < 0.1 - 1e-6)).all(axis=1))[0]
    touching = mesh.tets[(mesh.tets == inner).any(axis=1)][0]
    others = touching[touching != inner]
    a, b, c = nodes[others]
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal)
    nodes[inner] -= (1.0 - 6e-4) * normal * (normal @ (nodes[inner] - a))
    return TetMesh(nodes, mesh.tets, mesh.region)


def quietly(build: Callable[[], TetMesh]) -> TetMesh:
    """A mesh that is meant to be doubtful."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MeshWarning)
        return build()


SLIVERS = quietly(slivers)
NEEDLES = quietly(lambda: TetMesh(BLOCK.nodes * [1.0, 1.0, 0.02], BLOCK.tets, BLOCK.region))
TINY, HUGE = (quietly(lambda s=s: TetMesh(s * BLOCK.nodes, BLOCK.tets, BLOCK.region)) for s in (1e-3, 1e3))
TET = TetMesh(0.01 * np.vstack([np.zeros(3), np.eye(3)]), np.array([[0, 1, 2, 3]]), np.zeros(1, int))
QUADRATIC = quadratic(box((2, 2, 3), 0.1, distortion=0.1))
STIFF_CORE, SOFT_CORE = included(1e3), included(1e-3)
SIDE = np.where((BLOCK.nodes[:, 0] > BLOCK.nodes[:, 0].max() - 1e-9)[:, None], [-0.01, 0.0, 0.0], 0.0)


def solved(force: np.ndarray) -> np.ndarray:
    return Hard("", BLOCK, soft("stable-neo-hookean"), force).solve().displacement[0]


def moved(target: np.ndarray) -> np.ndarray:
    """Displacements of the free nodes of BLOCK to target (V, 3); its base stays."""
    return np.where(BLOCK.nodes[:, 2:] < 1e-9, 0.0, target - BLOCK.nodes)


HEIGHT = BLOCK.nodes[:, 2].max()
SPACING = 0.1 / 5
LOST = {
    "mirrored": moved(BLOCK.nodes * [1.0, 1.0, -1.0]),
    "flattened": moved(BLOCK.nodes * [1.0, 1.0, 0.0]),
    "scattered": moved(BLOCK.nodes + 0.5 * SPACING * np.random.default_rng(0).uniform(-1.0, 1.0, BLOCK.nodes.shape)),
}
COLLAPSED = {"onto a line": moved(BLOCK.nodes * [0.0, 0.0, 1.0]), "onto a point": moved(0.0 * BLOCK.nodes)}
CATALOGUE = {
    **{
        f"nu {poisson} {element}": Hard(
            "locks, or conjugate gradients stagnate", mesh, soft(law, poisson), pressed(mesh), element=element
        )
        for poisson in (0.499, 0.4999)
        for law, element, mesh in (
            ("stable-neo-hookean", "p1", BLOCK),
            ("neo-hookean", "smoothed", BLOCK),
            ("neo-hookean", None, QUADRATIC),
        )
    },
    "a core 1000 times stiffer": Hard("conditioning stops the iteration", *STIFF_CORE, pressed()),
    "a core 1000 times softer": Hard("soft elements turn inside out", *SOFT_CORE, pressed()),
    **{
        f"slivers, {law}": Hard("volumes change sign in the first step", SLIVERS, soft(law), pressed(SLIVERS))
        for law in EVERY_LAW
    },
    "needles": Hard("the worst elements rule the condition number", NEEDLES, soft("neo-hookean"), pressed(NEEDLES)),
    "a load that reverses": Hard(
        "the warm start is as wrong as can be", BLOCK, soft("stable-neo-hookean"), -pressed(), after=pressed()
    ),
    "a load that jumps": Hard(
        "the warm start helps nobody", BLOCK, soft("neo-hookean"), SIDE, after=pressed()
    ),
    "one element": Hard(
        "too small for the preconditioner", TET, soft("neo-hookean"), np.array([[0.0] * 3] * 3 + [[0.0, 0.01, -0.02]])
    ),
    "one element, two nodes held and a third in a plane": Hard(
        "hardly held",
        TET,
        soft("corotational"),
        np.array([[0.0] * 3] * 3 + [[0.0, 0.01, -0.01]]),
        held=np.array([[True] * 3, [False, True, True], [False, False, True], [False] * 3]),
    ),
    "a body of 0.1 mm": Hard("absolute tolerances", TINY, soft("stable-neo-hookean"), 1e-6 * pressed(TINY)),
    "a body of 100 m": Hard("absolute tolerances", HUGE, soft("stable-neo-hookean"), 1e6 * pressed(HUGE)),
    **{
        f"a tenfold overload, {law}": Hard(
            "Newton diverges, nodes are flung away", BLOCK, soft(law), 10.0 * pressed(), ends=ANYHOW
        )
        for law in EVERY_LAW
        if law != "linear"
    },
    **{
        f"{law} {name}": Hard(
            "inverted elements push the wrong way", BLOCK, soft(law), 1e-3 * pressed(), start
        )
        for name, start in LOST.items()
        for law in ("stable-neo-hookean", "corotational")
    },
    **{
        f"collapsed {name}": Hard(
            "a collapsed body is stationary", BLOCK, soft("stable-neo-hookean"), 1e-3 * pressed(), start
        )
        for name, start in COLLAPSED.items()
    },
    "a logarithm from inside out": Hard(
        "the energy is infinite", BLOCK, soft("neo-hookean"), 1e-3 * pressed(), LOST["mirrored"], ends=ANEW
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CATALOGUE)
def test_hard_case_ends_with_required_outcome(name: str) -> None:
    case = CATALOGUE[name]
    found = case.solve()
    outcome, u = found.outcome[0], found.displacement[0]
    assert outcome in case.ends, f"{case.wrong_elsewhere}: {outcome.value}"
    assert np.isfinite(u).all()
    if outcome.good or outcome in BEYOND:
        assert found.reached[0] == 1.0
        assert case.residual(u) <= 1.01 * TOLERANCE
    else:
        assert 0.0 <= found.reached[0] < 1.0
        assert np.isfinite(found.residual[0])
        # What is returned is in equilibrium under the share of the load that it names.
        if found.reached[0] > 0.0:
            share = Hard("", case.mesh, case.tissues, found.reached[0] * case.force)
            assert share.residual(u) <= 1.01 * TOLERANCE


@pytest.mark.parametrize("law", ["stable-neo-hookean", "corotational"])
@pytest.mark.parametrize("name", LOST)
def test_unloaded_body_returns_to_rest_from_bad_start(law: str, name: str) -> None:
    """With a negligible load, no displacement of the start remains."""
    found = Hard("", BLOCK, soft(law), 1e-9 * pressed(), LOST[name]).solve()
    assert found.outcome[0].good
    assert np.abs(found.displacement).max() <= 1e-6 * HEIGHT
    assert found.inverted[0] == 0


@pytest.mark.parametrize("law", ["stable-neo-hookean", "corotational"])
@pytest.mark.parametrize("name", LOST)
def test_newton_returns_inverted_body_to_rest(law: str, name: str) -> None:
    """Without a restart or load, the iteration leaves the inverted elements of its start."""
    effects = [Elasticity(soft(law)[0]), Held(), NodalForce()]
    problem = compile_problem(effects, base_held(BLOCK), find_device("cpu", "float64"))
    problem.begin(Cases(Loads((Nodal(0.0 * pressed()[None]),)), np.zeros(1)))
    descent = NewtonCG(build_rest_solver(problem), ACCURACY.inner)
    found = equilibrium_of(problem, descent, LOST[name].reshape(-1, 1), ACCURACY)
    assert found.outcome[0] is Outcome.CONVERGED
    assert np.abs(found.u).max() <= 1e-6 * HEIGHT


def test_zero_load_gives_zero_displacement_from_any_start() -> None:
    for start in (None, *LOST.values(), *COLLAPSED.values()):
        found = Hard("", BLOCK, soft("stable-neo-hookean"), 0.0 * pressed(), start).solve()
        assert not found.displacement.any()
        assert found.outcome[0].good


def test_overload_reports_its_reached_share() -> None:
    """A hundred times too much, with a small budget."""
    case = Hard("", BLOCK, soft("neo-hookean"), 100.0 * pressed(), accuracy=Accuracy(TOLERANCE, outer=6, steps=6))
    found = case.solve()
    assert found.outcome[0] in STOPPED
    assert 0.0 < found.reached[0] < 1.0
    assert found.residual[0] > 0.1
    assert (
        Hard("", BLOCK, case.tissues, found.reached[0] * case.force).residual(found.displacement[0]) <= 1.01 * TOLERANCE
    )


@pytest.mark.parametrize("mesh", [TINY, HUGE], ids=["0.1 mm", "100 m"])
def test_doubtful_mesh_size_warning_names_the_unit_option(mesh: TetMesh) -> None:
    with pytest.warns(MeshWarning, match="with unit m"):
        TetMesh(mesh.nodes, mesh.tets, mesh.region)


def test_sliver_mesh_has_tiny_dihedral_angles() -> None:
    assert 0.01 < compute_dihedral_angles(SLIVERS.nodes, SLIVERS.tets).min() < 0.15


def fem(anatomy: Anatomy, material: Tissue | None = SOFT, accuracy: Accuracy = TRAIN, batch: int = 64) -> Fem:
    return Fem(anatomy, [Elasticity(material), Held(), NodalForce()], accuracy, "cpu", batch, element="p1")


def loose() -> Anatomy:
    """Two blocks, of which one is held."""
    nodes = np.vstack([BLOCK.nodes, BLOCK.nodes + [1.0, 0.0, 0.0]])
    tets = np.vstack([BLOCK.tets, BLOCK.tets + len(BLOCK.nodes)])
    return hold(
        TetMesh(nodes, tets, np.zeros(len(tets))), np.append(BLOCK.nodes[:, 2] < 1e-9, np.zeros(len(BLOCK.nodes), bool))
    )


def flat() -> TetMesh:
    return TetMesh(BLOCK.nodes * [1.0, 1.0, 0.0], BLOCK.tets, BLOCK.region)


def with_nan(values: np.ndarray, bad: float) -> np.ndarray:
    out = values.copy()
    out[-1, -1] = bad
    return out


COUNT = len(BLOCK.nodes)
REFUSED = {
    "a force that is no number": (lambda: Loads((Nodal(with_nan(pressed(), np.nan)[None]),)), "not finite"),
    "an infinite force": (lambda: Loads((Nodal(with_nan(pressed(), np.inf)[None]),)), "not finite"),
    "a node that is nowhere": (lambda: TetMesh(with_nan(BLOCK.nodes, np.nan), BLOCK.tets, BLOCK.region), "finite"),
    "a force in the plane": (lambda: Loads((Nodal(np.zeros((1, COUNT, 2))),)), "shape"),
    "forces of another mesh": (
        lambda: fem(base_held(BLOCK)).deform(Loads((Nodal(np.zeros((1, 7, 3))),))),
        f"7 vertices, but the mesh has {COUNT}",
    ),
    "a body that nothing holds": (lambda: fem(hold(BLOCK, np.zeros(COUNT, bool))), "move rigidly"),
    "a piece that nothing holds": (lambda: fem(loose()), "loose piece"),
    "a region without a law": (lambda: fem(base_held(BLOCK), None), "region 0 has no tissue law"),
    "incompressible tissue": (lambda: Material("neo-hookean", 3000.0, 0.5), "Poisson's ratio is 0.5"),
    "tissue without stiffness": (lambda: Material("neo-hookean", 0.0, 0.4), "Young's modulus is 0"),
    "elements without volume": (flat, "zero or negative"),
    "a tolerance below single precision's floor": (
        lambda: Accuracy(tolerance=1e-7, precision="float32"),
        "float32 reaches 2e-05",
    ),
    "a tolerance below double precision's floor": (lambda: Accuracy(tolerance=1e-15), "float64 reaches 1e-11"),
    "a start of another mesh": (
        lambda: fem(base_held(BLOCK)).deform(Loads((Nodal(pressed()[None]),)), build_start(np.zeros((1, 7, 3)))),
        "start has displacements of shape",
    ),
    "more loads than memory holds": (lambda: _too_many(64), "at most"),
    "a batch wider than memory": (lambda: _too_many(10**9), "--batch"),
}


def _too_many(batch: int) -> None:
    """A fifth more loads than memory holds, if solved `batch` together: asked for, not stored."""
    rows = 3 * COUNT
    check_fits(
        rows,
        batch,
        int(1.2 * measure_host_bytes() / (24 * rows if batch == 64 else 184 * rows)),
        find_device("cpu", "float32"),
    )


@pytest.mark.parametrize("name", REFUSED)
def test_unsuitable_case_is_rejected_with_reason(name: str) -> None:
    build, reason = REFUSED[name]
    with pytest.raises(InputError, match=reason) as refusal:
        build()
    assert str(refusal.value).endswith(".")
