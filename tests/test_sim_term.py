"""One conformance suite for every term: derivatives, selected columns, bounds on steps."""

import numpy as np
import pytest
import scipy.sparse as sp
import warp as wp
from contact_examples import CONTACTS
from term_examples import EXAMPLES as OTHERS
from term_examples import LOGARITHMIC, MESH, ROWS, Example

from sim.discretisation.term import HistoryTerm, LocalBarrier, StepTerm, StrainTerm, Term
from sim.geometry.tetmesh import compute_signed_volumes
from sim.runtime.device import Device
from sim.terms.contact.tool_contact import ToolContactTerm
from sim.terms.element_kernels import MIN_VOLUME_RATIO

EXAMPLES = OTHERS | CONTACTS
INTERFACES = {
    "ElasticTerm": {"HistoryTerm", "StrainTerm"},
    "InertiaTerm": {"HistoryTerm", "StepTerm"},
    "ToolContactTerm": {"LocalBarrier"},
}


@pytest.fixture(params=EXAMPLES, scope="module")
def example(request: pytest.FixtureRequest) -> Example:
    return EXAMPLES[request.param]


@pytest.fixture(scope="module")
def built(example: Example, device: Device) -> Term:
    return example.build(device)


@pytest.fixture
def term(built: Term, example: Example) -> Term:
    """The term, begun afresh: a test may have dropped columns."""
    built.begin(example.cases)
    return built


def noise(*shape: int) -> np.ndarray:
    """The same for each test, whichever others run."""
    return np.random.default_rng(21).normal(size=shape)


def energy(term: Term, device: Device, u: np.ndarray) -> np.ndarray:
    out = wp.zeros(u.shape[1], dtype=wp.float64, device="cpu")
    term.energy(device.upload(u), out)
    return out.numpy()


def gradient(term: Term, device: Device, u: np.ndarray) -> np.ndarray:
    out = device.allocate(*u.shape)
    term.add_gradient(device.upload(u), out)
    return out.numpy()


def curvature(term: Term, device: Device, p: np.ndarray) -> np.ndarray:
    out = device.allocate(*p.shape)
    term.add_curvature(device.upload(p), out)
    return out.numpy()


def linearise(term: Term, device: Device, u: np.ndarray, definite: bool = False) -> None:
    flags = wp.array(np.full(u.shape[1], int(definite), np.int32), dtype=wp.int32, device="cpu")
    term.linearise(device.upload(u), flags)


def longest_step(term: Term, device: Device, u: np.ndarray, du: np.ndarray) -> np.ndarray:
    out = wp.full(u.shape[1], 1.0, dtype=device.scalar, device="cpu")
    term.longest_step(device.upload(u), device.upload(du), out)
    return out.numpy()


def assembled(term: Term, device: Device, u: np.ndarray, definite: bool = False) -> np.ndarray:
    """Curvature (3N, 3N) at one state u (3N,)."""
    linearise(term, device, u[:, None], definite)
    return np.hstack([curvature(term, device, unit[:, None]) for unit in np.eye(len(u))])


def test_term_has_a_name(term: Term) -> None:
    assert term.name


def test_gradient_is_the_derivative_of_the_energy(term: Term, example: Example, device: Device) -> None:
    h = 2e-7
    for p in noise(4, *example.u.shape):
        slope = (energy(term, device, example.u + h * p) - energy(term, device, example.u - h * p)) / (2.0 * h)
        exact = (gradient(term, device, example.u) * p).sum(axis=0)
        np.testing.assert_allclose(exact, slope, rtol=1e-6, atol=1e-6)


def test_curvature_is_the_derivative_of_the_gradient(term: Term, example: Example, device: Device) -> None:
    h = 1e-7
    linearise(term, device, example.u)
    for p in noise(4, *example.u.shape):
        change = (gradient(term, device, example.u + h * p) - gradient(term, device, example.u - h * p)) / (2.0 * h)
        exact = curvature(term, device, p)
        assert np.linalg.norm(exact - change) <= 1e-6 * max(np.linalg.norm(change), 1.0)


def test_curvature_is_symmetric_and_contains_diagonal_blocks(term: Term, example: Example, device: Device) -> None:
    term.keep(np.array([1]))
    K = assembled(term, device, example.u[:, 1])
    assert np.abs(K - K.T).max() <= 1e-10 * max(np.abs(K).max(), 1.0)
    out = wp.zeros((example.rows // 3, 1), dtype=device.matrix, device="cpu")
    term.add_diagonal(out)
    blocks = np.stack([K[i : i + 3, i : i + 3] for i in range(0, example.rows, 3)])
    np.testing.assert_allclose(out.numpy()[:, 0], blocks, atol=1e-10 * max(np.abs(K).max(), 1.0))


def test_term_results_are_added_to_the_output(term: Term, example: Example, device: Device) -> None:
    already = noise(*example.u.shape)
    out = device.upload(already)
    term.add_gradient(device.upload(example.u), out)
    np.testing.assert_allclose(out.numpy() - already, gradient(term, device, example.u), atol=1e-10)
    linearise(term, device, example.u)
    out = device.upload(already)
    term.add_curvature(device.upload(example.u), out)
    np.testing.assert_allclose(out.numpy() - already, curvature(term, device, example.u), atol=1e-10)
    total = wp.array(np.array([1.0, 2.0, 3.0]), dtype=wp.float64, device="cpu")
    term.energy(device.upload(example.u), total)
    np.testing.assert_allclose(total.numpy() - [1.0, 2.0, 3.0], energy(term, device, example.u), atol=1e-12)


@pytest.mark.parametrize("state", ["u", "crushed"])
def test_definite_curvature_is_positive(term: Term, example: Example, device: Device, state: str) -> None:
    u = example.u[:, 0] if state == "u" else example.crushed
    term.keep(np.array([0]))
    K = assembled(term, device, u, definite=True)
    assert np.linalg.eigvalsh(K).min() >= -1e-10 * max(np.abs(K).max(), 1.0)


@pytest.mark.parametrize("law", ["corotational", "neo-hookean", "stable-neo-hookean", "ogden"])
def test_plain_curvature_of_crushed_tissue_is_indefinite(law: str, device: Device) -> None:
    """Without indefinite curvature the test above could not fail."""
    example = EXAMPLES[law]
    term = example.build(device)
    term.begin(example.cases)
    K = assembled(term, device, example.crushed)
    assert np.linalg.eigvalsh(K).min() < -1e-3 * np.abs(K).max()


def test_definite_curvature_is_selected_for_each_column(term: Term, example: Example, device: Device) -> None:
    u = np.repeat(example.crushed[:, None], 3, axis=1)
    p = np.repeat(noise(example.rows, 1), 3, axis=1)
    linearise(term, device, u)
    plain = curvature(term, device, p)
    linearise(term, device, u, definite=True)
    definite = curvature(term, device, p)
    term.linearise(device.upload(u), wp.array(np.array([0, 1, 0]), dtype=wp.int32, device="cpu"))
    mixed = curvature(term, device, p)
    np.testing.assert_array_equal(mixed, np.where([False, True, False], definite, plain))


@pytest.mark.parametrize("columns", [[0], [2, 0], [1, 2]])
def test_term_with_selected_columns_agrees_with_new_term(
    term: Term, example: Example, device: Device, columns: list[int]
) -> None:
    index = np.array(columns)
    u, p = example.u[:, index], noise(example.rows, len(index))

    def answers() -> list[np.ndarray]:
        linearise(term, device, u)
        found = [energy(term, device, u), gradient(term, device, u), curvature(term, device, p)]
        memory = term.end(device.upload(u))
        return found if memory is None else [*found, memory]

    term.keep(index)
    kept = answers()
    term.begin(example.cases.select(index))
    for after, fresh in zip(kept, answers(), strict=True):
        np.testing.assert_allclose(after, fresh, rtol=1e-13, atol=1e-15)
        assert after.shape[0 if after is kept[0] or after.ndim >= 3 else -1] == len(index)


def test_rest_curvature_is_the_curvature_at_rest(term: Term, example: Example, device: Device) -> None:
    offered = term.rest_curvature()
    if offered is None:
        return
    assert sp.issparse(offered)
    term.keep(np.array([0]))
    if example.walled:
        assert np.linalg.eigvalsh(offered.toarray()).min() >= -1e-10 * np.abs(offered).max()
        return
    K = assembled(term, device, np.zeros(example.rows))
    np.testing.assert_allclose(offered.toarray(), K, atol=1e-10 * np.abs(K).max())


def test_longest_step_stays_in_the_domain(term: Term, example: Example, device: Device) -> None:
    longest = longest_step(term, device, example.u, example.flung)
    assert ((longest > 0.0) & (longest <= 1.0)).all()
    for fraction in np.linspace(0.0, 1.0, 23):
        assert np.isfinite(energy(term, device, example.u + fraction * longest * example.flung)).all()
    beyond = energy(term, device, example.u + example.flung)
    if example.walled:
        assert (longest < 1.0).any()
        assert np.isfinite(beyond).all()
    elif example.bounded:
        assert (longest < 1.0).all()
        assert np.isposinf(beyond).all()
    else:
        assert (longest == 1.0).all()
        assert np.isfinite(beyond).all()


def test_longest_step_of_a_tiny_motion_is_one(term: Term, example: Example, device: Device) -> None:
    assert (longest_step(term, device, example.u, 1e-6 * example.flung) == 1.0).all()


def test_longest_step_never_raises_the_bound(term: Term, example: Example, device: Device) -> None:
    out = wp.full(3, 1e-9, dtype=device.scalar, device="cpu")
    term.longest_step(device.upload(example.u), device.upload(example.flung), out)
    assert (out.numpy() <= 1e-9).all()


def test_curvature_is_unchanged_by_later_changes_of_state(term: Term, example: Example, device: Device) -> None:
    """The outer iteration changes u in place: the curvature remains that of the linearisation."""
    u, p = device.upload(example.u), noise(*example.u.shape)
    term.linearise(u, wp.zeros(3, dtype=wp.int32, device="cpu"))
    before = curvature(term, device, p)
    u.assign(1.5 * example.u)
    np.testing.assert_array_equal(curvature(term, device, p), before)


@pytest.mark.parametrize("law", LOGARITHMIC)
@pytest.mark.parametrize("size", [1e-3, 1e-2, 0.1, 10.0])
def test_log_law_steps_keep_a_tenth_of_volume(law: str, device: Device, size: float) -> None:
    """At every point of the path; twice the step would not, so that the bound is sharp."""
    example = EXAMPLES[law]
    term = example.build(device)
    term.begin(example.cases)
    du = size * np.random.default_rng(13).normal(size=(ROWS, 3))
    longest = longest_step(term, device, example.u, du)

    def volumes(fraction: float) -> np.ndarray:
        moved = (example.u + fraction * longest * du).T.reshape(3, -1, 3) + MESH.nodes
        return np.stack([compute_signed_volumes(nodes, MESH.tets) for nodes in moved])

    floor = MIN_VOLUME_RATIO * volumes(0.0)
    fractions = np.linspace(0.0, 1.0, 101)
    assert all((volumes(fraction) >= floor - 1e-16).all() for fraction in fractions)
    doubled = np.array([(volumes(2.0 * fraction) >= floor).all(axis=1) for fraction in fractions]).all(axis=0)
    assert ((longest == 1.0) | ~doubled).all()
    assert (size >= 0.1) == (longest < 1.0).all()


@pytest.mark.parametrize("name", CONTACTS)
def test_every_example_tool_has_a_contact_force(name: str, device: Device) -> None:
    """In every column, else the tests of contact would be empty; the forces of tools balance those on the tissue."""
    example = EXAMPLES[name]
    term = example.build(device)
    assert isinstance(term, ToolContactTerm)
    term.begin(example.cases)
    force = term.compute_reaction(device.upload(example.u))[:, :, :3]
    assert (np.linalg.norm(force, axis=2) > 0.0).all()
    bears = -gradient(term, device, example.u).T.reshape(3, -1, 3).sum(axis=1)
    np.testing.assert_allclose(force.sum(axis=1), bears, atol=1e-9)


def test_spring_history_creeps_and_is_returned_rows_first(device: Device) -> None:
    example = EXAMPLES["spring"]
    spring = example.build(device)
    spring.begin(example.cases)
    before, u = example.cases.memory["spring"], example.u.T.reshape(3, -1, 3)
    share = 1.0 - np.exp(-np.array([0.5, 2.0, 0.1]))[:, None, None]
    np.testing.assert_allclose(spring.end(device.upload(example.u)), before + share * (u - before), atol=1e-15)


def test_term_has_the_interfaces_that_solvers_look_for(built):
    """Interfaces are recognised by the names of their members: a renamed member would silently lose the history."""
    found = {kind.__name__ for kind in (HistoryTerm, StepTerm, StrainTerm, LocalBarrier) if isinstance(built, kind)}
    assert found == INTERFACES.get(type(built).__name__, set())
