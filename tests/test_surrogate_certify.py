"""Certificates: an estimate of a prediction's error that is its error, and which deformer a budget buys."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import make_box

from sim.accuracy import Accuracy
from sim.deformation import Outcome, guess
from sim.effects import Elasticity, Held, ToolForce
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import push
from surrogate.data.tool_loads import draw
from surrogate.evaluation.certificate import SHARE, certify
from surrogate.evaluation.choose import Offer, choose

EFFECTS = (Elasticity(), Held(), ToolForce())
FINE = Accuracy(1e-6)


@pytest.fixture(scope="module")
def fem(box):
    return Fem(box, EFFECTS, FINE, "cpu", element="p1")


@pytest.fixture(scope="module")
def loads(box):
    return draw("palpation", box, 20, 3)


@pytest.fixture(scope="module")
def truth(fem, loads):
    return fem.deform(loads)


@pytest.fixture(scope="module")
def predicted(truth, box):
    """The tumour alone, three to seven per cent too far."""
    known = truth.at(box.tumour_nodes)
    share = np.linspace(1.03, 1.07, len(truth))[:, None, None]
    return replace(known, displacement=share * known.displacement, memory={})


def largest(motion, tumour):
    return np.linalg.norm(motion[:, tumour], axis=2).max(axis=1)


def test_a_small_known_field_is_the_estimate(fem, truth, loads, box):
    field = 1e-3 * np.roll(truth.displacement, 1, axis=0)
    state = replace(truth, displacement=truth.displacement + field, memory={})
    found = certify(fem, loads, state)
    assert np.allclose(found.estimate, largest(field, box.tumour_nodes), rtol=0.02)
    assert np.allclose(found.correction, -field, atol=0.05 * np.abs(field).max())
    assert (found.before > found.after).all() and found.sound.all()


def test_the_estimate_is_the_error(fem, truth, loads, predicted, box):
    found = certify(fem, loads, predicted)
    error = np.linalg.norm(predicted.displacement - truth.at(box.tumour_nodes).displacement, axis=2).max(axis=1)
    effectivity = found.estimate / error
    assert np.mean((effectivity > 0.8) & (effectivity < 1.25)) >= 0.95
    assert found.correction.shape == predicted.displacement.shape
    assert found.cost.total > 0.0 and set(found.cost.seconds) >= {"relax", "solve", "search"}


def test_what_is_corrected_is_nearer_to_equilibrium_and_what_is_left_is_reported(fem, truth, loads, predicted, box):
    found = certify(fem, loads, predicted)
    tumour = box.tumour_nodes
    off = largest(found.corrected.displacement - truth.displacement, tumour)
    assert (off < 0.1 * found.estimate).all() and (found.after < 0.1 * found.before).all()
    assert np.array_equal(fem.residual(loads, found.corrected), found.after)
    ratio = found.left / off
    assert 0.3 < np.median(ratio) < 3.0
    assert np.array_equal(found.sound, found.left <= SHARE * found.estimate)
    assert all(outcome in (Outcome.CONVERGED, Outcome.BUDGET) for outcome in found.corrected.outcome)


def test_loads_that_two_steps_do_not_settle_are_not_sound(fem, loads, box):
    """Six times as much force as palpation has creases the surface."""
    hard = loads.rows(np.arange(12)).scaled(6.0)
    known = fem.deform(hard).at(box.tumour_nodes)
    error = 0.02 * np.linalg.norm(known.displacement, axis=2).max(axis=1)
    found = certify(fem, hard, replace(known, displacement=1.02 * known.displacement, memory={}))
    effectivity = found.estimate / error
    assert 4 < found.sound.sum() < 12 and (found.corrected.iterations == 2).any()
    assert (abs(effectivity - 1.0) < 0.2)[found.sound].all() and effectivity[~found.sound].max() > 2.0
    assert (found.after < found.before).all()


def test_certificate_leaves_out_a_step_that_raises_the_residual(fem, loads, box):
    hard, steps = loads.rows(np.arange(12)).scaled(6.0), []

    def corrected(*given):
        found, before, missing = fem.corrected(*given)
        steps.append(replace(found, residual=found.residual + len(steps)))
        return steps[-1], before, missing

    known = fem.deform(hard).at(box.tumour_nodes)
    found = certify(SimpleNamespace(anatomy=box, corrected=corrected), hard, known)
    assert len(steps) == 3 and np.array_equal(found.corrected.displacement, steps[0].displacement)


def test_one_load_alone_says_the_same_as_in_a_batch(box, loads, predicted, fem):
    alone, row = Fem(box, EFFECTS, FINE, "cpu", live=True, element="p1"), np.array([4])
    together = certify(fem, loads, predicted)
    for solver in (fem, alone):
        single = certify(solver, loads.rows(row), predicted.rows(row))
        assert single.estimate[0] == pytest.approx(together.estimate[4], rel=0.05)


def test_a_prediction_that_lies_inside_out_is_left_alone(fem, truth, loads, box):
    wild = guess(-4.0 * box.mesh.nodes[None].repeat(len(loads), axis=0))
    found = certify(fem, loads, wild)
    error = largest(wild.displacement - truth.displacement, box.tumour_nodes)
    assert np.allclose(found.estimate, error, rtol=0.01) and (found.corrected.inverted == 0).all()


def test_quadratic_elements_are_certified_too(box):
    """On the CPU their preconditioner is no inverse, so that each load's own part is solved by itself."""
    quadratic, load = Fem(box, EFFECTS, Accuracy(1e-4), "cpu", element="p2"), push([0, 0, 0], [0.01, 0, -0.05], 8e-3)
    truth = quadratic.deform(load)
    found = certify(quadratic, load, replace(truth, displacement=1.05 * truth.displacement))
    assert found.estimate == pytest.approx(0.05 * largest(truth.displacement, box.tumour_nodes), rel=0.2)
    assert quadratic.residual(load, found.corrected) == pytest.approx(found.after, rel=1e-2)


def test_without_a_part_to_settle_the_linear_solves_do_it_alone(box):
    """An opening of half the surface is no small place."""
    free = box.mesh.nodes[:, 2] > -30e-3
    body = replace(box, held=box.held & ~free[:, None])
    fem, load = Fem(body, EFFECTS, FINE, "cpu", element="p1"), push([0, 0, 0], [0.01, 0, -0.1], 8e-3)
    truth = fem.deform(load)
    found = certify(fem, load, replace(truth, displacement=1.05 * truth.displacement))
    assert found.estimate == pytest.approx(0.05 * largest(truth.displacement, box.tumour_nodes), rel=0.05)


def test_other_meshes_and_other_loads_are_refused(fem, truth, loads, predicted, box):
    other = make_box(cells=(10, 10, 6))
    foreign = guess(np.zeros((20, len(other.mesh.nodes) + 1000, 3)))
    for state in (foreign, foreign.at(other.tumour_nodes), truth.at(np.arange(50))):
        with pytest.raises(InputError, match="another mesh"):
            certify(fem, loads, state)
    with pytest.raises(InputError, match="20 predictions do not answer 5 loads"):
        certify(fem, loads.rows(np.arange(5)), predicted)


OFFERS = (Offer("table", 0.4, 0.2), Offer("net", 0.1, 0.5), Offer("twin", 0.1, 0.9), Offer("fem", 0.01, 40.0))


@pytest.mark.parametrize(
    ("mm", "ms", "name", "why"),
    [
        (0.5, None, "table", "fastest of 4 deformers within 0.5 mm"),
        (0.2, None, "net", "fastest of 3"),
        (0.05, None, "fem", "fastest of 1"),
        (None, 1.0, "net", "most accurate of 3 deformers within 1 ms"),
        (None, 100.0, "fem", "most accurate of 4"),
        (0.2, 1.0, "net", "fastest of 2 deformers within 0.2 mm and 1 ms"),
    ],
)
def test_a_budget_buys_what_it_says(mm, ms, name, why):
    choice = choose(OFFERS, mm, ms)
    assert choice.offer.name == name and why in choice.reason and "of 4 here" in choice.reason


@pytest.mark.parametrize(
    ("mm", "ms", "nearest"),
    [
        (0.001, None, "most accurate is fem"),
        (None, 0.1, "fastest is table"),
        (0.05, 1.0, "most accurate is net.*fastest is fem"),
        (None, None, "no bound"),
        (-1.0, None, "positive"),
    ],
)
def test_what_no_deformer_meets_is_a_sentence(mm, ms, nearest):
    with pytest.raises(InputError, match=nearest):
        choose(OFFERS, mm, ms)
