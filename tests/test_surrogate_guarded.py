"""Model with finite elements as fallback: choice for each load, and description of the source."""

import argparse
import threading
from dataclasses import replace

import numpy as np
import pytest
from theatres import player, small

from scenes.options.patient_options import add_patient, open_patient
from scenes.page.scene_solvers import ALL_ACTIVE, SceneSolvers
from scenes.play.deformers import GUARDED, RestDeformer
from scenes.script.tool_paths import Touch
from sim.deformation import Outcome
from sim.errors import InputError
from surrogate.data.tool_loads import draw
from surrogate.model.guarded import describe_error, find_first_model
from surrogate.model.held_out import MAX_VERTEX_ERROR, HeldOutErrors, measure_held_out
from surrogate.model.store import load, save


@pytest.fixture(scope="module")
def guarded(theatre):
    return theatre.build_deformer(GUARDED, small())


@pytest.fixture(scope="module")
def loads(box):
    return draw("palpation", box, 6, 3)


@pytest.fixture(scope="module")
def predicted(guarded, loads):
    return guarded.model.deform(loads)


@pytest.fixture(scope="module")
def solved(guarded, loads):
    return guarded.fem.deform(loads)


def limited(guarded, limit):
    """Whatever the bounds of loads are called, a limit alone decides."""
    return replace(guarded, limit=limit, model=replace(guarded.model, bounds=None, bound=1e-3))


def test_model_predicts_loads_with_bound_below_limit(guarded, loads, predicted):
    sure = limited(guarded, 2e-3).deform(loads)
    inside = [row for row, outcome in enumerate(predicted.outcome) if outcome.good]
    assert inside and np.array_equal(sure.displacement[inside], predicted.displacement[inside])
    assert all(sure.outcome[row] is Outcome.PREDICTED for row in inside)


def test_fem_solves_loads_with_bound_above_limit(guarded, loads, solved):
    answer = limited(guarded, 0.5e-3).deform(loads)
    assert answer.displacement == pytest.approx(solved.displacement, abs=1e-9) and answer.outcome == solved.outcome
    assert answer.source == solved.source and np.isnan(answer.bound).all()


def test_each_load_is_compared_with_its_own_bound(guarded, loads, predicted, solved):
    """Half of the bounds are below the limit; result at vertices in the requested order."""
    bounds = np.linspace(1e-4, 6e-4, len(loads))
    bounds[2] = np.nan
    marked = replace(predicted, bound=np.stack([bounds, bounds]), outcome=(Outcome.PREDICTED,) * len(loads))
    assert replace(guarded, limit=3.5e-4, model=replace(guarded.model, bound=1.0)).find_unreliable(marked).tolist() == [
        False, False, True, True, True, True,
    ]  # fmt: skip
    far = replace(marked, outcome=(Outcome.EXTRAPOLATED,) * len(loads))
    assert replace(guarded, limit=1.0).find_unreliable(far).all()
    nodes, limit = guarded.model.nodes[5:2:-1], float(np.sort(predicted.bound[0])[2]) + 1e-9
    some = replace(guarded, limit=limit)
    handed = some.find_unreliable(predicted)
    assert 0 < handed.sum() < len(loads)
    answer = some.deform(loads, at=nodes)
    expected = np.where(
        handed[:, None, None], solved.restrict(nodes).displacement, predicted.restrict(nodes).displacement
    )
    assert answer.displacement == pytest.approx(expected, abs=1e-9) and answer.nodes.tolist() == nodes.tolist()
    assert f"for {handed.sum()} of {len(loads)} loads" in answer.source


def test_failed_fem_solve_keeps_the_model_prediction(guarded, loads, predicted, box):
    answer = replace(guarded, limit=0.0, fem=RestDeformer(box)).deform(loads)
    assert np.array_equal(answer.displacement, predicted.displacement) and answer.outcome == predicted.outcome
    assert answer.bound == pytest.approx(predicted.bound, nan_ok=True)


def test_fem_solve_starts_from_the_last_solution(guarded, loads):
    one, strict = loads.select(np.array([0])), replace(guarded, limit=0.0)
    first = strict.deform(one)
    again = strict.deform(one, start=first)
    assert again.iterations[0] < first.iterations[0]
    assert strict.deform(one, start=guarded.model.deform(one)).iterations[0] == first.iterations[0]
    with pytest.raises(InputError, match="one row for each"):
        strict.deform(one, start=guarded.fem.deform(loads))


@pytest.mark.parametrize("limit", [0.0, 1.0])
def test_frame_names_model_or_fem_as_source(theatre, limit):
    play = player(theatre, small(), GUARDED)
    play = replace(play, deformer=replace(play.deformer, limit=limit))
    frame = play.draw(0, 0.0, Touch(force=0.1))
    by_model = find_first_model(play.deformer, frame.deformation) is not None
    assert by_model == (limit == 1.0) == (frame.model_error is not None) == (frame.distance_error is not None)
    assert ("FEM reference" in " ".join(frame.head)) != by_model
    moved = player(theatre, small(), "fem" if not by_model else theatre.select_best(small())).draw(
        0, 0.0, Touch(force=0.1)
    )
    assert frame.moved == pytest.approx(moved.moved, abs=1e-9)


def test_page_solve_starts_from_the_previous_solution(theatre):
    cast = SceneSolvers(theatre, small(), GUARDED, threading.Lock())
    play = cast.get_player(GUARDED)
    cast.players[GUARDED, ALL_ACTIVE] = replace(play, deformer=replace(play.deformer, limit=0.0))
    question = (0, Touch(force=0.1))
    first, again = (cast.predict(GUARDED, question).deformation for _ in range(2))
    assert first.iterations[0] > again.iterations[0] == 0
    assert again.displacement == pytest.approx(first.displacement, abs=1e-6)


def test_guard_limit_is_set_by_the_user(theatre):
    strict = replace(theatre, limit=5e-5)
    assert (
        strict.build_deformer(GUARDED, small()).limit == 5e-5
        and theatre.build_deformer(GUARDED, small()).limit == MAX_VERTEX_ERROR
    )
    assert "where its error may exceed 0.05 mm" in strict.describe_deformer(GUARDED, small())
    parser = argparse.ArgumentParser()
    add_patient(parser)
    asked = parser.parse_args(["--guard", "0.05", "--device", "cpu"])
    assert open_patient(asked).limit == pytest.approx(5e-5)
    assert open_patient(parser.parse_args(["--device", "cpu"])).limit is None
    for words in ("0", "-1", "nan"):
        with pytest.raises(InputError, match="give a positive number of millimetres"):
            open_patient(parser.parse_args(["--guard", words, "--device", "cpu"]))


def test_guarded_deformer_is_listed_with_description(theatre):
    assert GUARDED in theatre.list_deformers(
        small()
    ) and "where its error may exceed 0.2 mm" in theatre.describe_deformer(GUARDED, small())


def test_held_out_errors_count_fem_solutions_as_exact():
    distance = 1e-3 * np.array([[0.1, 0.3], [0.02, 0.02], [0.4, 0.4]])
    stated = measure_held_out(
        distance, np.full(3, 10e-3), 1e-3 * np.array([0.5, 0.1, 0.1]), np.array([False, False, True])
    )
    assert stated.mean == pytest.approx((0.02 + 0.002 + 0.04) / 3) and stated.guarded == pytest.approx(0.002 / 3)
    assert stated.solved == pytest.approx(2 / 3) and stated.p999 is None and not stated.is_sufficient
    assert "2.07 % of the motion alone; with FEM for" in str(stated)
    many = measure_held_out(np.full((1000, 2), 0.3e-3), np.full(1000, 1.0), np.full(1000, 0.1e-3), np.zeros(1000, bool))
    assert many.p999 == pytest.approx(0.3e-3) and many.mean < 0.01 and not many.is_sufficient
    assert measure_held_out(distance[1:2], np.full(1, 10e-3), np.full(1, np.nan), np.zeros(1, bool)).solved == 1.0


def test_guard_limit_is_chosen_from_held_out_errors(theatre):
    """Largest limit that leaves 1 % of the motion, and 0.2 mm at 99.9 % of the vertices; otherwise FEM solves all."""
    bound, inside = 1e-3 * np.array([0.15, 0.08, 0.03, 0.005]), np.zeros(4, bool)
    distance = 1e-3 * np.array([[0.30], [0.06], [0.02], [0.004]])
    wide, middle, none = (measure_held_out(distance, np.full(4, size), bound, inside) for size in (1e-2, 1e-3, 5e-5))
    assert (wide.limit, wide.solved) == (MAX_VERTEX_ERROR, 0.0) and wide.guarded == pytest.approx(wide.mean)
    assert (middle.limit, middle.solved) == (0.05e-3, 0.5) and middle.guarded == pytest.approx(0.024 / 4)
    assert (none.limit, none.solved, none.guarded) == (0.0, 1.0, 0.0) and "above 0 mm) 0.00 %" in str(none)
    many = measure_held_out(
        np.full((1000, 1), 0.3e-3), np.full(1000, 1.0), np.full(1000, 0.15e-3), np.zeros(1000, bool)
    )
    assert (many.limit, many.solved) == (0.1e-3, 1.0)
    (_, model), *_ = theatre.models.items()
    some = replace(theatre, models={"series-gp": replace(model, held_out=middle)})
    assert some.build_deformer(GUARDED, small()).limit == 0.05e-3
    assert replace(some, limit=1e-3).build_deformer(GUARDED, small()).limit == 1e-3


@pytest.mark.parametrize(
    ("mean", "bound", "who"),
    [
        (0.009, 0.3e-3, "series-gp"),
        (0.011, 0.1e-3, GUARDED),
        (None, 0.1e-3, "series-gp"),
        (None, 0.3e-3, GUARDED),  # of few loads the mean is not known: its worst vertex says as much
        (None, np.nan, GUARDED),
    ],
)
def test_default_deformer_depends_on_bound_and_held_out_error(theatre, mean, bound, who):
    (_, model), *_ = theatre.models.items()
    stated = None if mean is None else HeldOutErrors(mean, 0.001, None, 0.3)
    some = replace(theatre, models={"series-gp": replace(model, bound=bound, held_out=stated)})
    assert some.select_default(small()) == who and some.select_best(small()) == "series-gp"
    said = describe_error(some.models["series-gp"])
    assert said.endswith(": scenes play it guarded" if who == GUARDED else ": scenes play it without FEM")


def test_model_file_stores_held_out_errors(theatre, tmp_path):
    (name, model), *_ = theatre.models.items()
    stated = HeldOutErrors(0.02, 0.004, 0.3e-3, 0.4)
    save(tmp_path / "a.npz", {name: replace(model, held_out=stated)})
    assert load(tmp_path / "a.npz", model.anatomy)[name].held_out == stated
    for bad in (replace(stated, mean=float("nan")), replace(stated, solved=1.1), replace(stated, p999="1")):
        save(tmp_path / "b.npz", {name: replace(model, held_out=bad)})
        with pytest.raises(InputError, match="held-out"):
            load(tmp_path / "b.npz", model.anatomy)


def test_unsupported_scene_is_rejected_with_reason(theatre):
    with pytest.raises(InputError, match=r"could ask knows the scene retract: .*Retraction\. Choose fem\."):
        theatre.build_deformer(GUARDED, small("retract"))
