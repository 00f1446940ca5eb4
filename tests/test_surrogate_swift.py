"""One load at the tumour, which has a way of its own, is answered as it is among others."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from sim.deformation import Outcome
from sim.errors import InputError
from sim.loads import Loads, Pushed, push, stacked
from surrogate.data.cortex_patch import nearest, open_patch
from surrogate.data.encode import Basis, tool_features
from surrogate.data.tool_loads import draw
from surrogate.model.conformal import features_of, fitted_bound
from surrogate.model.learned import Learned, Part
from surrogate.model.training_range import envelope_of, measured
from surrogate.regressors.force_series import Series
from surrogate.regressors.series_residual import Remainder
from surrogate.training.tabulate_series import radii_between, with_middles

MODES, RADII = 13, radii_between(5e-3, 7.5e-3)


@pytest.fixture(scope="module")
def dome(box):
    """The box bent, so that its cortex faces many ways."""
    x, y, z = box.mesh.nodes.T
    nodes = np.column_stack([x, y, z - 8.0 * (x**2 + 0.7 * y**2 + 0.3 * x * y)])
    return replace(box, mesh=replace(box.mesh, nodes=nodes))


@pytest.fixture(scope="module")
def taught(dome):
    return draw("palpation", dome, 150, 0).of(Pushed)


@pytest.fixture(scope="module")
def inside(dome):
    return draw("palpation", dome, 40, 9)


@pytest.fixture(scope="module")
def made(dome, taught, inside):
    """A model of random numbers, in the proportions of what is learnt; by radii and modes."""

    def model(radii=RADII, modes=MODES):
        random = np.random.default_rng(4)
        patch, nodes = open_patch(dome), dome.tumour_nodes
        triangles, places = with_middles(patch)
        directions = np.linalg.qr(random.normal(size=(3 * len(nodes), modes)))[0].T.astype(np.float32)
        basis = Basis(nodes, directions)
        size = 1e-2 * np.repeat([1.0, 3.0, 9.0], [3, 6, 10])[:, None] / np.arange(1, modes + 1)
        table = size * random.normal(size=(len(places), len(radii), 19, modes))
        series = Series(patch.points, triangles, radii, table.astype(np.float32))
        X = tool_features(patch, taught)
        known = {
            "mean": np.append(X.mean(axis=0), 30.0),
            "deviation": np.array([*[1e-2] * 3, *[0.3] * 3, 0.1, 1e-3, 15.0]),
            "length": random.uniform(0.5, 3.0, 9),
            "offset": 1e-3 * random.normal(size=modes),
            "noise": np.array(1e-6),
            "seen": random.normal(size=(len(X), 9)),
            "dual": random.normal(size=(len(X), modes)),
            "faint": np.array(0.1),
        }
        learnt = Remainder.restored(known)
        told = features_of(taught, measured(patch, taught))
        error = np.abs(random.normal(1e-5, 1e-5, (len(told), len(nodes))))
        bounds = fitted_bound((told, error.max(axis=1)), told, X[:, 6], error)
        parts = (Part("tool", series, basis), Part("tool", learnt, basis))
        envelope = replace(envelope_of(patch, taught), reach=nearest(inside.of(Pushed).point, taught.point)[1].max())
        return Learned(dome, parts, envelope, bounds=bounds)

    return model


@pytest.fixture(scope="module")
def model(made):
    return made()


@pytest.fixture(scope="module")
def asked(inside, dome):
    """Forty each: as taught, beside the cortex, too strong, aslant, of other widths, weak, of none; and on the rim."""
    random = np.random.default_rng(2)
    cause, rim = inside.of(Pushed), open_patch(dome).rim.mean(axis=1)
    size = np.linalg.norm(cause.force, axis=1)
    strongest = 1.2 * size.max()
    away = random.normal(size=cause.point.shape)
    away *= (0.95 * cause.footprint * random.random(len(size)) / np.linalg.norm(away, axis=1))[:, None]
    other = [
        replace(cause, point=cause.point + away),
        replace(cause, force=2.0 * cause.force * (strongest / size)[:, None]),
        replace(cause, force=cause.force * random.normal(size=cause.force.shape)),
        replace(cause, footprint=np.geomspace(1e-3, 2e-2, len(cause.footprint))),
        replace(cause, force=1e-3 * cause.force),
        replace(cause, force=0.0 * cause.force),
    ]
    return stacked([inside, *[Loads((each,)) for each in other], push(rim, [0.01, 0.0, -0.1], 6e-3)])


def compared(model, loads):
    """The answers one by one, after they were held to those of the batch."""
    nodes = model.anatomy.tumour_nodes
    batch = model.deform(loads, at=nodes)
    single = [model.deform(loads.rows(slice(k, k + 1)), at=nodes) for k in range(len(loads))]
    for k, answer in enumerate(single):
        size = np.abs(batch.displacement[k]).max()
        assert np.abs(answer.displacement[0] - batch.displacement[k]).max() <= 3e-6 * size
        assert answer.outcome == batch.outcome[k : k + 1] and answer.nodes is nodes
        assert np.allclose(answer.bound[:, 0], batch.bound[:, k], rtol=1e-9, atol=0.0, equal_nan=True)
        for name in ("iterations", "residual", "time", "reaction", "reached", "inverted"):
            ours, theirs = getattr(answer, name), getattr(batch, name)[k : k + 1]
            assert ours.dtype == theirs.dtype and np.array_equal(ours, theirs, equal_nan=True), name
    return single


def test_alone_or_among_others_the_answer_is_the_same(model, asked):
    single = compared(model, asked)
    assert vars(model)["_swift"] is not None
    kinds = [{answer.outcome[0] for answer in single[first : first + 40]} for first in range(0, 280, 40)]
    inside, outside = {Outcome.PREDICTED}, {Outcome.EXTRAPOLATED}
    assert kinds == [inside, inside | outside, outside, inside | outside, inside | outside, inside, inside]
    for still in single[240:280]:
        assert (still.displacement == 0.0).all() and (still.bound == 0.0).all()


def test_a_force_whose_square_is_none_moves_nothing(model, inside):
    cause = inside.of(Pushed)
    for answer in compared(model, Loads((replace(cause, force=1e-200 * cause.force),))):
        assert (answer.displacement == 0.0).all() and (answer.bound == 0.0).all()


@pytest.mark.parametrize("radii", [np.array([7e-3]), np.geomspace(4e-3, 9e-3, 5)], ids=["one", "five"])
def test_any_number_of_radii(made, asked, radii):
    compared(made(radii), asked)


def test_as_many_modes_as_lie_side_by_side_and_more(made, asked):
    full, wider = made(modes=64), made(modes=65)
    compared(full, asked)
    compared(wider, asked)
    assert vars(full)["_swift"] is not None and vars(wider)["_swift"] is None


def test_a_series_alone_without_bounds_or_with_boundless_ones(model, asked):
    alone = replace(model, parts=model.parts[:1], bounds=None)
    compared(alone, asked)
    assert vars(alone)["_swift"] is not None
    endless = replace(model, bounds=replace(model.bounds, quantile=model.bounds.quantile * [[1.0], [np.inf]]))
    compared(endless, asked)


def test_classes_of_force_have_their_own_quantiles(model, asked):
    edges = np.quantile(np.linalg.norm(asked.of(Pushed).force[:40], axis=1), [0.3, 0.6])
    quantile = np.array([[1.0, 2.0, 4.0], [2.0, 3.0, 5.0]])
    compared(replace(model, bounds=replace(model.bounds, edges=edges, quantile=quantile)), asked)


def test_answers_are_their_own_when_two_threads_ask(model, asked):
    nodes = model.anatomy.tumour_nodes
    wanted = model.deform(asked, at=nodes).displacement
    single = [asked.rows(slice(k, k + 1)) for k in range(len(asked))]
    with ThreadPoolExecutor(2) as pool:
        answers = list(pool.map(lambda one: model.deform(one, at=nodes), single * 4, chunksize=1))
    for k, answer in enumerate(answers):
        truth = wanted[k % len(single)]
        assert np.abs(answer.displacement[0] - truth).max() <= 3e-6 * np.abs(truth).max()


def test_the_shorter_way_refuses_what_the_longer_one_does(model, inside):
    cause, nodes = inside.rows(slice(0, 1)).of(Pushed), model.anatomy.tumour_nodes
    sparse = replace(model, envelope=replace(model.envelope, reach=1.0))  # everywhere is near a taught point
    for each in (model, sparse):
        assert each._swift is not None
        for way in ([0.0, 0.0, 1.0], [0.0, 0.0, 1.1 * cause.footprint[0]], [0.0, 0.0, -20e-3], [1e29, 0.0, 0.0]):
            with pytest.raises(InputError, match="does not touch the open cortex"):
                each.deform(Loads((replace(cause, point=cause.point + way),)), at=nodes)
    with pytest.raises(InputError, match="N at most: give up to 3 times that"):
        model.deform(Loads((replace(cause, force=100.0 * cause.force),)), at=nodes)
