"""Mass-spring model: its law, its stiffness at small strain, and rejected input."""

import numpy as np
import pytest
import warp as wp
from boxes import base_held
from boxes import box as make_mesh

from sim.accuracy import REFERENCE
from sim.discretisation.element import build_linear_elements
from sim.effects import Elasticity, Held, NodalForce, Pulsation
from sim.errors import InputError
from sim.fem import Fem
from sim.geometry.tetmesh import TetMesh
from sim.loads import Loads, Nodal
from sim.material import Material
from sim.terms.laws.springs import LAW, compute_spring_coefficients

vec20 = wp.types.vector(20, wp.float64)
REGULAR = TetMesh(
    1e-2 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]]), np.array([[0, 2, 1, 3]]), np.ones(1, int)
)
LAME = np.array([[1000.0, 4000.0]])


@wp.kernel(enable_backward=False)
def evaluate(
    H: wp.array(dtype=wp.mat33d), D: wp.array(dtype=wp.mat33d), c: vec20, energy: wp.array(dtype=wp.float64),
    stress: wp.array(dtype=wp.mat33d), change: wp.array(dtype=wp.mat33d),
):  # fmt: skip
    i = wp.tid()
    energy[i] = LAW.energy(H[i], c)
    stress[i] = LAW.stress(H[i], c)
    change[i] = LAW.stress_change(H[i], D[i], c)


def coefficients(mesh=REGULAR, lame=LAME):
    return compute_spring_coefficients(lame, build_linear_elements(mesh, np.ones(len(mesh.tets), bool)).gradient)


def run(H, D):
    count = len(H)
    out = wp.zeros(count, wp.float64), wp.zeros(count, wp.mat33d), wp.zeros(count, wp.mat33d)
    given = [wp.array(H, dtype=wp.mat33d), wp.array(D, dtype=wp.mat33d), vec20(*coefficients()[0])]
    wp.launch(evaluate, count, [*given, *out], device="cpu")
    return [each.numpy() for each in out]


def test_spring_stress_and_its_change_are_derivatives(device):
    random = np.random.default_rng(0)
    H, D = random.normal(0.0, 0.3, (20, 3, 3)), random.normal(0.0, 1.0, (20, 3, 3))
    _, stress, change = run(H, D)
    up, down = run(H + 1e-6 * D, D), run(H - 1e-6 * D, D)
    np.testing.assert_allclose((up[0] - down[0]) / 2e-6, np.einsum("nij,nij->n", stress, D), rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose((up[1] - down[1]) / 2e-6, change, rtol=1e-5, atol=1e-3)


def test_regular_tetrahedron_has_published_spring_stiffness():
    """15 mu V / sum L^2 = 0.118 E L at Poisson's ratio 1/4; Lloyd et al. 2007: 2 root 2 / 25 = 0.113."""
    mesh, edge = REGULAR, 2e-2 * np.sqrt(2.0)
    mu = 1000.0
    k = coefficients(lame=np.array([[mu, mu]]))[0, 0] * mesh.volumes[0]
    assert k == pytest.approx(0.1179 * 2.5 * mu * edge, rel=1e-3)
    assert k == pytest.approx(2.0 * np.sqrt(2.0) / 25.0 * 2.5 * mu * edge, rel=0.05)


def test_springs_over_all_directions_agree_with_hookes_law():
    """The mean over rotations of a strain's energy is Hooke's: mu e:e + lambda/2 (tr e)^2."""
    random = np.random.default_rng(1)
    turns = np.linalg.qr(random.normal(size=(4000, 3, 3)))[0]
    for strain in (np.diag([1e-4, 0.0, 0.0]), np.array([[0, 1e-4, 0], [1e-4, 0, 0], [0, 0, 0.0]])):
        turned = turns @ strain @ turns.transpose(0, 2, 1)
        energy = run(turned, turned)[0].mean()
        hooke = LAME[0, 0] * (strain**2).sum() + 0.5 * LAME[0, 1] * np.trace(strain) ** 2
        assert energy == pytest.approx(hooke, rel=0.01)


def test_rigid_motion_of_springs_has_no_energy():
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    energy, stress, _ = run((turn - np.eye(3))[None], np.zeros((1, 3, 3)))
    assert abs(energy[0]) < 1e-12 and np.abs(stress).max() < 1e-9


def test_bar_of_springs_stretches_within_model_error():
    """Kuhn's tetrahedra have all long diagonals in one direction, which makes springs softer by a half."""
    mesh = make_mesh((4, 4, 12), 0.06, distortion=0.2)
    anatomy = base_held(mesh)
    top = mesh.nodes[:, 2] > 0.06 - 1e-9
    force = np.where(top[:, None], [0.0, 0.0, 1e-4 / top.sum()], 0.0)[None]
    effects = (Elasticity(Material("neo-hookean", 3000.0, 0.3)), Held(), NodalForce())
    both = [
        Fem(anatomy, effects, REFERENCE, "cpu", element=element).deform(Loads((Nodal(force),))).displacement[0, top, 2]
        for element in ("springs", "p1")
    ]
    assert both[0].mean() == pytest.approx(both[1].mean(), rel=0.6)


def test_unsupported_tissue_of_springs_is_rejected():
    with pytest.raises(InputError, match=r"Poisson's ratio 0\.25 or more"):
        coefficients(lame=np.array([[1000.0, 500.0]]))
    anatomy = base_held(make_mesh((2, 2, 2), 0.06))
    for tissue, more in (
        (Material("neo-hookean", 3e3, 0.4, ((0.5, 1.0),)), ()),
        (Material("linear", 3e3, 0.4), (Pulsation(),)),
    ):
        with pytest.raises(InputError, match="neither relaxation nor pulsation"):
            Fem(anatomy, (Elasticity(tissue), Held(), *more), device="cpu", element="springs")
