"""Tabulated series, and learning of its remainder."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_box
from poison import poisoned

from sim.accuracy import REFERENCE, TRAIN
from sim.effects import NodalForce, build_push_effects
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads, Pushed
from sim.material import Material, to_tissue_json
from sim.runtime.journal import open_journal
from surrogate.array_functions import QuantisedTable
from surrogate.data.cortex_patch import open_patch
from surrogate.data.dataset import read_dataset
from surrogate.data.encode import ENCODERS, compute_tool_features, split_forces
from surrogate.data.simulate import simulate
from surrogate.data.splits import DiscSplit
from surrogate.model.store import load, save
from surrogate.regressors.force_series import MAX_ORDER, ORDER_COLUMNS, Series
from surrogate.training.examples import Examples
from surrogate.training.expansion import ADDED_BASIS, COARSE_BASIS, SERIES_MODELS, Expansion
from surrogate.training.fem_tables import add_edge_midpoints, tabulate_series
from surrogate.training.train import list_learners, train

TISSUE = Material("neo-hookean", 3000.0, 0.45)


def pushes(patch, count, seed, radius=(6e-3, 8e-3), most=0.15):
    random = np.random.default_rng(seed)
    point, normal = patch.place_points(random.random((count, 3)))
    force = random.uniform(0.02, most, (count, 1)) * (normal + 0.3 * random.normal(size=(count, 3)))
    return Pushed(point, force, random.uniform(*radius, count))


def unrounded(table):
    """A table (places, radii, 19, r) that is not rounded."""
    columns = table.reshape(-1, 19 * table.shape[-1]).astype(np.float32)
    return QuantisedTable(columns, np.ones(columns.shape[1], np.float32))


def every_motion(fem, nodes):
    return fem.build_reading(nodes, np.eye(3 * len(nodes)).reshape(-1, len(nodes), 3))


def test_tabulated_series_matches_finite_element_series(box, patch, tmp_path):
    fem = Fem(box, build_push_effects(box, TISSUE), REFERENCE, "cpu", batch=200, element="p1")
    nodes = box.tumour_nodes
    loads = pushes(patch, 30, 3, (7e-3, 7e-3))
    reading = every_motion(fem, nodes)
    exact = fem.compute_series(Loads((loads,)), MAX_ORDER, reading)
    (triangles, places), radii = add_edge_midpoints(patch), np.array([7e-3])
    heard = []
    table = tabulate_series(fem, places, radii, reading, lambda done, total: heard.append((done, total)))
    series = Series(patch.points, triangles, radii, unrounded(table))
    assert heard[-1] == (len(places), len(places))

    # Stopped at its second step, it goes on there, and comes to the same.
    def stop(done, total):
        if done > step:
            raise KeyboardInterrupt

    step, last = heard[0][0], []
    with pytest.raises(KeyboardInterrupt), open_journal(tmp_path / "rows", {}) as journal:
        tabulate_series(fem, places, radii, reading, stop, journal)
    with open_journal(tmp_path / "rows", {}) as journal:
        again = tabulate_series(fem, places, radii, reading, lambda done, total: last.append(done), journal)
    assert np.array_equal(again, table) and last == [done for done, _ in heard[2:]]
    size, _ = split_forces(loads)
    predicted = series.predict(compute_tool_features(patch, loads)) * size[:, None]
    wanted = exact.sum(axis=1)
    # The box's triangles are as long as the tool is wide.
    assert np.linalg.norm(predicted - wanted) < 0.02 * np.linalg.norm(wanted)
    linear = exact[:, 0]
    assert np.linalg.norm(predicted - wanted) < 0.25 * np.linalg.norm(linear - wanted)


def simulated(path, box, count=160):
    """Pushes of one width on a box."""
    fem = Fem(box, (*build_push_effects(box, TISSUE), NodalForce()), TRAIN, "cpu", element="p1")
    loads = Loads((pushes(open_patch(box), count, 5, (7e-3, 7e-3), 0.25),))
    simulate(path, fem, loads, {"tissue": to_tissue_json(TISSUE), "element": "p1"})
    return read_dataset(path)


@pytest.fixture(scope="module")
def data(box, tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("series") / "data.h5", box)


@pytest.fixture(scope="module")
def expansion(data):
    """What all may read: nobody writes into its table."""
    found = Expansion(data, "cpu")
    found.table.table.setflags(write=False)
    return found


@pytest.fixture(scope="module")
def trained(data, expansion):
    return train(data, ["linear", *SERIES_MODELS], expansion=expansion)


def test_tabulated_series_matches_fem_in_the_example_basis(data, expansion, box, patch):
    pushed = data.loads.get(Pushed)
    some = np.flatnonzero(data.good)[:90]
    loads = Pushed(pushed.point[some], pushed.force[some], pushed.footprint[some])
    nodes = (expansion.tumour, expansion.cortex)
    bases = expansion.build_bases(
        Examples(loads, *(data.read_displacement(at)[some] for at in nodes)), ADDED_BASIS, COARSE_BASIS
    )
    fem = Fem(box, build_push_effects(box, TISSUE), REFERENCE, "cpu", element="p1")
    places = np.array([0, 17, 60, 120, 198])
    point = np.repeat(add_edge_midpoints(patch)[1][places], 3, axis=0)
    units = Loads((Pushed(point, np.tile(np.eye(3), (len(places), 1)), np.full(len(point), 7e-3)),))
    predicted = expansion.build_series(bases, np.zeros(len(expansion.positions), bool))
    for at, basis, found, exact in zip(nodes, bases, predicted, expansion.exact_parts, strict=True):
        wanted = fem.compute_series(units, MAX_ORDER, every_motion(fem, at), 3) @ basis.modes.T
        for terms in ORDER_COLUMNS[len(exact) :]:
            table = found.table.values.reshape(len(expansion.positions), *wanted.shape[1:])
            miss = np.linalg.norm((table[places] - wanted)[:, terms])
            assert miss < 0.06 * np.linalg.norm(wanted[:, terms])  # rounded to 1 in 500 of the largest


def test_first_two_series_orders_are_exact_for_any_tool(expansion, box):
    """Inside the rim no remainder is left; over the rim the table holds the missing part."""
    fem = Fem(box, build_push_effects(box, TISSUE), REFERENCE, "cpu", element="p1")
    loads = pushes(expansion.patch, 40, 8, (7e-3, 7e-3))
    inside = expansion.patch.compute_edge_distance(loads.point) > loads.footprint
    assert 10 < inside.sum() < 40
    exact = fem.compute_series(Loads((loads,)), 2, every_motion(fem, expansion.tumour))
    size = split_forces(loads)[0][:, None, None]
    found = [
        size * part.compute_response(ENCODERS[part.encoder](expansion.patch, loads))
        for part in expansion.exact_parts[0]
    ]
    for order, (motion, limit) in enumerate(zip(found, (1e-3, 3e-2), strict=True)):
        off = np.linalg.norm(motion.reshape(40, -1) - exact[:, order], axis=1) / np.linalg.norm(exact[:, order], axis=1)
        assert off[inside].max() < limit
    many = [
        part.compute_response(ENCODERS[part.encoder](expansion.patch, replaced(loads, 3)))
        for part in expansion.exact_parts[0]
    ]
    some = [part.compute_response(ENCODERS[part.encoder](expansion.patch, loads)) for part in expansion.exact_parts[0]]
    for few, more in zip(some, many, strict=True):  # more than are answered at once
        np.testing.assert_allclose(more, np.tile(few, (3, 1, 1)), rtol=1e-4, atol=1e-6)


def test_resumed_series_has_equal_table_and_no_solve_time(tmp_path):
    small = make_box(cells=(8, 8, 4), spacing=8e-3, tumour=12e-3, depth=20e-3, opening=22e-3)
    data = simulated(tmp_path / "data.h5", small, 100)
    whole, later = (Expansion(data, "cpu", journal_path=tmp_path / "rows", max_pairs=0) for _ in range(2))
    assert whole.table.seconds > 0.0 and np.isnan(later.table.seconds)
    assert np.array_equal(whole.table.table, later.table.table)
    took = [train(data, ["series"], expansion=each).scores[0].solves.seconds for each in (whole, later)]
    assert took[0] > 0.0 and took[1] is None


def test_second_order_is_interpolated_above_pair_limit(data, trained):
    known = Expansion(data, "cpu", max_pairs=100)
    assert [len(parts) for parts in known.exact_parts] == [1, 1]
    again = train(data, ["series"], expansion=known)
    kinds = [type(part.regressor).__name__ for part in again.models["series"].parts]
    assert kinds == ["Linear", "Linear", "Series", "Series"]
    assert again.scores[0].mean_mm < 0.2 * trained.scores[0].mean_mm


def replaced(loads, times):
    """The same loads, so many times."""
    return Pushed(*(np.concatenate([each] * times) for each in (loads.point, loads.force, loads.footprint)))


def test_series_has_smaller_error_than_linear_table(trained):
    linear, series, learnt = trained.scores
    # A hundred loads are nothing to the process yet: it must do no harm.
    assert series.mean_mm < 0.2 * linear.mean_mm and learnt.mean_mm < 1.5 * series.mean_mm


def test_gp_correction_halves_series_error_on_trained_cortex(tmp_path):
    """Benefit of `series-gp`: nine open nodes and 300 loads, every fourth a test load anywhere.

    A Gaussian process with wrong units would leave the error of the series unchanged.
    """
    small = make_box(cells=(6, 6, 4), spacing=9e-3, tumour=12e-3, depth=20e-3, opening=15e-3)
    data = simulated(tmp_path / "data.h5", small, 300)
    fourth = np.where(np.arange(data.good.sum()) % 4 == 3, 0, -1)
    nowhere = DiscSplit(np.full((1, 3), 1.0), 1e-3, fourth, 1.0)
    series, learnt = train(data, SERIES_MODELS, split=nowhere, expansion=Expansion(data, "cpu")).scores
    assert learnt.mean_percent < 0.5 * series.mean_percent and learnt.mean_mm < 0.5 * series.mean_mm


def test_series_training_ignores_held_out_discs(trained, data, expansion, tmp_path):
    """Bit-identical with random displacements of untrained loads and random series in held-out discs."""
    split = trained.split
    rows = np.flatnonzero(data.good)[~split.training_mask]
    wild = read_dataset(poisoned(data.path, tmp_path / "wild.h5", rows)[0])
    again = Expansion(wild, "cpu")
    inside = split.is_covered(again.positions)
    assert 0 < inside.sum() < len(inside)
    again.table.table[inside] = np.random.default_rng(0).normal(size=again.table.table[inside].shape)
    before, after = (train(each.data, SERIES_MODELS, split=split, expansion=each) for each in (expansion, again))
    for name in SERIES_MODELS:
        for one, other in zip(before.models[name].parts, after.models[name].parts, strict=True):
            assert np.array_equal(one.basis.modes, other.basis.modes)
            states = one.regressor.state(), other.regressor.state()
            assert all(np.array_equal(states[0][key], states[1][key]) for key in states[0])
    assert [row.mean_mm for row in before.scores] == [row.mean_mm for row in trained.scores[1:]]
    assert min(row.mean_mm for row in after.scores) > 1.0


def test_training_solve_counts_match_hand_count(trained, data):
    """Hand count: 19 terms at each place and radius outside the discs, 3 unit forces a node, and the loads.

    Unit forces on nodes inside the discs are counted once more.
    """
    linear, series, learnt = (row.solves for row in trained.scores)
    loads_given, units = int(trained.split.training_mask.sum()), len(data.unit_good)
    outside = int((~trained.split.is_covered(add_edge_midpoints(open_patch(data.anatomy))[1])).sum())
    inside = 3 * int(trained.split.is_covered(open_patch(data.anatomy).points).sum())
    assert (linear.loads, linear.units, linear.series, linear.inside) == (loads_given, units, 0, inside) and inside
    assert series == learnt and (series.loads, series.units, series.inside) == (loads_given, units, inside)
    assert series.series == outside * 19 and series.total == loads_given + units + outside * 19
    rates = [float(data.provenance[f"seconds a {each}"]) for each in ("load", "unit response")]
    assert linear.seconds == pytest.approx(loads_given * rates[0] + units * rates[1]) and min(rates) > 0.0
    assert series.seconds > linear.seconds
    said = {name: text for name, text in data.provenance.items() if not name.startswith("seconds")}
    silent = train(replace(data, provenance=said), ["linear"])
    assert silent.scores[0].solves == replace(linear, seconds=None)


def test_series_reduces_cortex_motion_error(trained, data, box, patch):
    cortex = np.setdiff1d(patch.nodes, box.tumour_nodes)
    truth = data.read_displacement(cortex)
    miss = {name: np.linalg.norm(model.deform(data.loads, at=cortex).displacement - truth, axis=2).mean()
            for name, model in trained.models.items()}  # fmt: skip
    assert miss["series"] < 0.7 * miss["linear"] and miss["series-gp"] < 0.7 * miss["linear"]


def test_stored_series_predict_identically(trained, data, box, tmp_path):
    save(tmp_path / "model.npz", trained.models)
    again = load(tmp_path / "model.npz", box)
    for name in SERIES_MODELS:
        before, after = trained.models[name].deform(data.loads), again[name].deform(data.loads)
        assert np.array_equal(before.displacement, after.displacement) and np.array_equal(before.bound, after.bound)


def test_series_models_require_a_tissue(data):
    untold = replace(data, provenance={})
    assert not set(SERIES_MODELS) & set(list_learners(untold)) and set(SERIES_MODELS) < set(list_learners(data))
    with pytest.raises(InputError, match="does not state its tissue"):
        train(untold, ["series"])
