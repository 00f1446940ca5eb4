"""Every family of deformation models meets the same contract: loads, constraints, outcome, cost, rejected input."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import box as make_mesh
from conftest import make_box

from sim.anatomy import Anatomy
from sim.deformation import Deformer, Outcome
from sim.effects import Elasticity, Gravity, build_push_effects
from sim.errors import InputError
from sim.families.registry import ELEMENTS_BY_FAMILY, FAMILIES, build_family
from sim.fem import Fem
from sim.geometry.tetmesh import TetMesh
from sim.loads import Loads, Posture, Prescribed, Pushed
from sim.material import Material

SOFT = Material("neo-hookean", 3000.0, 0.45)
# Largest error of the motion under a small force, relative to the largest motion; None: geometry alone.
ERRORS = {
    "kelvinlets": 0.7,
    "thin-plate": None,
    "lattice": None,
    "mass-spring": 0.35,
    "xpbd": 0.4,
    "boundary-elements": 0.25,
    "condensed": 0.01,
    "explicit": 0.01,
    "element-free": 0.25,
}


def pushes(count=1, force=0.02):
    inward = np.array([[0.1 * k, 0.0, -1.0] for k in range(count)])
    points = np.array([[2e-3 * k, 0.0, 0.0] for k in range(count)])
    return Loads((Pushed(points, force * inward, np.full(count, 9e-3)),))


@pytest.fixture(scope="module")
def body():
    return make_box((8, 8, 6), 8e-3)


@pytest.fixture(scope="module")
def exact(body):
    return Fem(body, build_push_effects(body, SOFT), device="cpu", element="smoothed").deform(pushes(2))


@pytest.fixture(scope="module", params=sorted(FAMILIES))
def family(request, body):
    return request.param, build_family(request.param, body, build_push_effects(body, SOFT), "cpu")


def test_error_bounds_are_listed_for_every_family():
    assert sorted(ERRORS) == sorted(FAMILIES)


def test_family_meets_contract_of_deformers(family, body):
    model = family[1]
    result = model.deform(pushes(2))
    assert isinstance(model, Deformer)
    assert model.anatomy is body
    assert result.displacement.shape == (2, len(body.mesh.nodes), 3)
    assert result.cost.total > 0.0
    assert result.source
    np.testing.assert_allclose(result.reaction[:, 0, :3], pushes(2).causes[0].force)
    some = body.tumour_nodes[::2]
    alone = model.deform(pushes(2).select(np.array([1])), at=some)
    np.testing.assert_allclose(alone.displacement[0], result.displacement[1, some], atol=2e-4 * 1e-3, rtol=1e-3)
    assert result.inverted[0] == 0
    assert result.stretch[0, 0] < 1.0 < result.stretch[1, 0]


def test_zero_force_causes_no_displacement(family):
    result = family[1].deform(pushes(force=0.0))
    assert np.abs(result.displacement).max() < 1e-12


def test_fixed_vertices_hardly_move(family, body):
    result = family[1].deform(pushes())
    fixed = body.fixed.all(axis=1)
    moved = np.linalg.norm(result.displacement[0], axis=1)
    assert moved[fixed].max() <= (0.15 if ERRORS[family[0]] is None else 1e-6) * moved.max()


def test_family_meets_its_error_bound(family, exact):
    name, model = family
    field, truth = model.deform(pushes(2)).displacement, exact.displacement
    error = np.linalg.norm(field - truth, axis=2).max() / np.linalg.norm(truth, axis=2).max()
    if ERRORS[name] is None:
        assert np.einsum("bvi,bvi->b", field, truth).min() > 0.0
    else:
        assert error < ERRORS[name]


def test_small_displacements_are_proportional_to_load(family):
    one, two = (family[1].deform(pushes(force=size)).displacement for size in (1e-4, 2e-4))
    assert np.abs(two - 2.0 * one).max() < 0.01 * np.abs(two).max()


def build_hard_case(case, body):
    """Return an anatomy, its tissue and loads of a case that is hard for solvers."""
    if case == "slivers":
        inner = ~(body.fixed.all(axis=1) | body.craniotomy)
        thin = TetMesh(body.mesh.nodes - [0.0, 0.0, 7.6e-3] * inner[:, None], body.mesh.tets, body.mesh.region)
        body = replace(body, mesh=thin)  # the lowest layer has a twentieth of its thickness
    stiff = {2: Material("neo-hookean", 3e5, 0.45)} if case == "stiff tumour" else {}
    tissue = Elasticity(Material("neo-hookean", 3000.0, 0.499 if case == "nu 0.499" else 0.45), stiff)
    loads = pushes(force=3.0 if case == "overload" else 0.05)
    if case == "edge of the opening":
        edge = Pushed(np.array([[24e-3, 0.0, 0.0]]), np.array([[0.05, 0.0, -0.02]]), np.array([4e-3]))
        loads = Loads((edge,))
    return body, tissue, loads


@pytest.mark.parametrize("case", ["nu 0.499", "slivers", "overload", "stiff tumour", "edge of the opening"])
@pytest.mark.parametrize("name", sorted(FAMILIES))
def test_hard_case_has_finite_result_and_correct_outcome(name, case, body):
    body, tissue, loads = build_hard_case(case, body)
    result = build_family(name, body, build_push_effects(body, tissue), "cpu").deform(loads)
    assert np.isfinite(result.displacement).all()
    if result.outcome[0] in (Outcome.CONVERGED, Outcome.CONVERGED_IN_STEPS, Outcome.CONVERGED_ANEW):
        assert result.inverted[0] == 0
    if case == "overload":
        assert not result.outcome[0].good


@pytest.mark.parametrize("name", sorted(set(FAMILIES) - set(ELEMENTS_BY_FAMILY)))
def test_unsupported_effects_and_loads_are_rejected(name, body):
    with pytest.raises(InputError, match=r"does not compute Gravity.*finite elements"):
        build_family(name, body, (*build_push_effects(body, SOFT), Gravity()), "cpu")
    relaxing = replace(SOFT, prony=((0.5, 1.0),))
    with pytest.raises(InputError, match="tissue that relaxes"):
        build_family(name, body, build_push_effects(body, relaxing), "cpu")
    model = build_family(name, body, build_push_effects(body, SOFT), "cpu")
    posture = Posture(np.array([[0.0, -1.0, 0.0]]), np.zeros(1), np.ones(1))
    with pytest.raises(InputError, match="Posture, which no effect uses"):
        model.deform(Loads((posture,)))
    with pytest.raises(InputError, match="vert"):
        model.deform(pushes(), at=np.array([10**6]))


def test_body_with_removed_tissue_deforms(family, body):
    """Vertices without tetrahedra, several tools, prescribed motion, and no load at all."""
    name, model = family
    lowest = np.argsort(body.mesh.nodes[body.mesh.tets, 2].mean(axis=1))
    near = lowest[np.isin(body.mesh.tets[lowest], np.flatnonzero(~body.fixed.all(axis=1))[:1]).any(axis=1)]
    rest = body.remove_elements(near)
    assert rest.orphaned.any()
    again = build_family(name, rest, build_push_effects(rest, SOFT), "cpu").deform(pushes())
    whole = model.deform(pushes())
    assert np.abs(again.displacement - whole.displacement).max() < 0.5 * np.abs(whole.displacement).max()
    assert again.outcome == whole.outcome
    two = Loads((pushes().causes[0], pushes(force=0.01).causes[0]))
    assert np.abs(model.deform(two).displacement).max() > np.abs(whole.displacement).max()
    assert len(model.deform(pushes().select(np.zeros(0, int)))) == 0
    if name not in ELEMENTS_BY_FAMILY:
        with pytest.raises(InputError, match="does not compute Prescribed"):
            model.deform(Loads((Prescribed(np.zeros((1, len(body.mesh.nodes), 3))),)))


def test_unknown_family_is_rejected(body):
    with pytest.raises(InputError, match="no family of models is called 'springs': choose one of kelvinlets"):
        build_family("springs", body, build_push_effects(body, SOFT))


def test_partly_fixed_or_closed_body_is_rejected():
    mesh = make_mesh((3, 3, 2), 0.06)
    low = mesh.nodes[:, 2] < 1e-9
    side = (mesh.nodes[:, 0] < 1e-9)[:, None] & [True, False, False]
    half = Anatomy(mesh, low[:, None] | side, np.zeros_like(mesh.nodes), ~low)
    for name in ("condensed", "xpbd"):
        with pytest.raises(InputError, match="in all directions or in none"):
            build_family(name, half, build_push_effects(half, SOFT), "cpu")
    closed = replace(half, fixed=np.isin(np.arange(len(low)), mesh.surface)[:, None] & [True] * 3)
    with pytest.raises(InputError, match="open a craniotomy"):
        build_family("condensed", closed, build_push_effects(closed, SOFT), "cpu")
