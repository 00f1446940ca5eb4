"""Composition of a problem: only required terms, and as few launches for many loads as for one."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from boxes import base_held, box, top_forces
from oracle import energy_density
from tiny_terms import Spring, Wall

from sim.accuracy import Accuracy, Precision
from sim.compile import compile_problem
from sim.discretisation.problem import Problem
from sim.discretisation.term import Cases
from sim.effects import Elasticity, Held, NodalForce, ToolForce
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads, Nodal, Prescribed, Pushed
from sim.material import BRAIN, Material
from sim.runtime.device import Device

MESH = box((2, 2, 3), 0.1, distortion=0.15)
ANATOMY = base_held(MESH)
ROWS = MESH.nodes.size
TIGHT = Accuracy(tolerance=1e-10)


@pytest.fixture
def launches(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Names of the kernels launched."""
    names: list[str] = []
    plain = wp.launch

    def counting(kernel: wp.Kernel, *arguments: object, **named: object) -> object:
        names.append(kernel.key)
        return plain(kernel, *arguments, **named)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(wp, "launch", counting)
    yield names


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_kernel_launches_are_independent_of_batch_size(launches: list[str], precision: Precision) -> None:
    """Identical loads take the same iterations, so that the whole solves can be compared launch by launch."""
    accuracy = Accuracy(tolerance=1e-4, precision=precision)
    fem = Fem(ANATOMY, [Elasticity(), Held(), ToolForce(), NodalForce()], accuracy, "cpu", batch=64, element="p1")

    def solved(count: int) -> tuple[list[str], np.ndarray]:
        launches.clear()
        push = Pushed(*(np.repeat(x, count, axis=0) for x in ([[0.03, 0.03, 0.1]], [[0.1, 0.0, -0.3]], [0.02])))
        found = fem.deform(Loads((push, Nodal(top_forces(MESH, np.repeat([[0.1, 0.2, 0.0]], count, axis=0))))))
        return list(launches), found.iterations

    few, iterations = solved(4)  # of still fewer, each is solved by itself
    many, together = solved(64)
    assert iterations[0] >= 3
    assert (together == iterations[0]).all()
    assert many == few


def test_only_modules_of_used_effects_are_imported() -> None:
    """In a fresh interpreter: laws, terms and libraries that a scene does not name are not imported."""
    script = (
        "import sys; sys.path.insert(0, 'tests')\n"
        "import numpy as np\n"
        "from boxes import base_held, box, top_forces\n"
        "from sim.effects import Elasticity, Gravity, Held, NodalForce\n"
        "from sim.fem import Fem\n"
        "from sim.loads import Loads, Nodal\n"
        "from sim.material import Material\n"
        "mesh = box((1, 1, 1))\n"
        "effects = [Elasticity(Material('linear', 3000.0, 0.3)), Held(){more}]\n"
        "fem = Fem(base_held(mesh), effects, device='cpu', element='p1')\n"
        "print(*sorted(name for name in sys.modules if name.startswith('sim.terms.')))\n"
        "print(*sorted({{name.split('.')[0] for name in sys.modules}} & {{'torch', 'meshio', 'trimesh', 'nibabel', "
        "'nilearn', 'viser', 'cv2', 'sklearn', 'surrogate', 'scenes', 'ar'}}))\n"
    )

    def imported(more: str) -> list[str]:
        run = subprocess.run(
            [sys.executable, "-c", script.format(more=more)],
            cwd=Path(__file__).parents[1],
            capture_output=True,
            text=True,
            check=True,
            timeout=120,
        )
        terms, libraries = run.stdout.split("\n")[:2]
        assert libraries == ""
        return [name.removeprefix("sim.terms.") for name in terms.split()]

    own = ["elasticity", "element_functions", "element_kernels", "laws"]
    own += ["laws.invariants", "laws.law", "laws.linear", "state_source"]
    assert imported("") == own
    assert imported(", NodalForce()") == sorted([*own, "dead_force"])
    assert imported(", Gravity()") == sorted([*own, "dead_force", "gravity"])


def test_kernels_of_absent_effects_are_not_launched(launches: list[str]) -> None:
    fem = Fem(ANATOMY, [Elasticity(), Held()], TIGHT, "cpu", element="p1")
    value = np.where(ANATOMY.fixed, 1e-3, 0.0)[None]
    fem.deform(Loads((Prescribed(value),)))
    names = {name.split("__")[0] for name in launches}
    assert "average" not in names  # no footprint is moved
    assert "bound_step" not in names  # the stable law has no domain to stay in
    assert any("add_gradient" in name for name in launches)


def test_kernels_of_absent_loads_are_not_launched(launches: list[str]) -> None:
    """Both effects are present, only nodal forces act: no tool is integrated, and no force is subtracted twice."""
    fem = Fem(ANATOMY, [Elasticity(), Held(), ToolForce(), NodalForce()], TIGHT, "cpu", element="p1")
    launches.clear()
    fem.problem.begin(Cases(Loads((Nodal(top_forces(MESH, np.array([[0.1, 0.0, 0.0]]))),)), np.zeros(1)))
    fem.problem.gradient(fem.problem.device.allocate(fem.problem.rows, 1))
    assert len([name for name in launches if "subtract" in name]) == 1
    assert not [name for name in launches if "press" in name or "spread" in name]


@pytest.mark.parametrize(
    ("effects", "sentence"),
    [
        ([Held(), NodalForce()], "no effect resists deformation"),
        ([Elasticity(), Elasticity(), Held()], "Elasticity occurs 2 times"),
        ([Elasticity(), Held(), "gravity"], "no effect is called str: choose from Elasticity"),
        (
            [Elasticity(regions={4: Material("linear", 1.0, 0.0)}), Held()],
            r"region 4 \(ventricles\), but the mesh has the regions \[0",
        ),
        ([Elasticity(default=None), Held()], "region 0 has no tissue law"),
        ([Elasticity(), NodalForce()], "can move rigidly"),
    ],
)
def test_invalid_combinations_of_effects_are_rejected(device: Device, effects: list, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        compile_problem(effects, ANATOMY, device)


def test_potential_is_the_sum_of_its_terms(device: Device) -> None:
    plain = compile_problem([Elasticity(), Held(), NodalForce()], ANATOMY, device)
    extra = Spring(device, ROWS, 0.5), Wall(device, MESH.nodes, 0.1005, 1.5e-3, 1e4)
    problem = Problem((*plain.terms, *extra), plain.constraint, device)
    u = 1e-4 * np.random.default_rng(9).normal(size=(ROWS, 2))
    problem.begin(Cases(Loads((Nodal(top_forces(MESH, np.array([[0.1, 0.0, 0.2], [0.0, 0.0, -0.1]]))),)), np.zeros(2)))
    parts, total = [], np.zeros((ROWS, 2))
    for term in problem.terms:
        out, gradient = wp.zeros(2, dtype=wp.float64, device="cpu"), device.allocate(ROWS, 2)
        term.energy(device.upload(u), out)
        term.add_gradient(device.upload(u), gradient)
        parts.append(out.numpy())
        total += gradient.numpy()
    assert all(part.all() for part in parts)
    np.testing.assert_allclose(problem.energy(device.upload(u)), np.sum(parts, axis=0), rtol=1e-13)
    np.testing.assert_allclose(problem.gradient(device.upload(u)).numpy(), total, atol=1e-13)
    X = MESH.nodes[MESH.tets]
    rest = np.swapaxes(X[:, 1:] - X[:, :1], 1, 2)
    for column in range(2):
        x = X + u[:, column].reshape(-1, 3)[MESH.tets]
        F = np.swapaxes(x[:, 1:] - x[:, :1], 1, 2) @ np.linalg.inv(rest)
        psi = energy_density(BRAIN.law, F, *BRAIN.lame)
        assert parts[0][column] == pytest.approx((MESH.volumes * psi).sum(), rel=1e-10)


def test_solve_integrates_its_tools_once(launches: list[str]) -> None:
    """The solution, the reactions and the moments use the same footprints."""
    fem = Fem(ANATOMY, [Elasticity(), Held(), ToolForce()], TIGHT, "cpu", element="p1")
    launches.clear()
    fem.deform(Loads((Pushed(np.array([[0.03, 0.03, 0.1]]), np.array([[0.0, 0.0, -0.1]]), np.array([0.02])),)))
    assert launches.count("_integrate_footprint") == 1
