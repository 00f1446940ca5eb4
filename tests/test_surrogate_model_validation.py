"""Models that no training makes: each rejected with its reason."""

from dataclasses import replace

import numpy as np
import pytest
from test_surrogate_store import bounds

from sim.errors import InputError
from surrogate.data.dataset import read_dataset
from surrogate.data.encode import Basis
from surrogate.data.simulate import simulate
from surrogate.data.tool_loads import draw
from surrogate.model.learned import ModelPart
from surrogate.model.store import load, save
from surrogate.training.train import train


@pytest.fixture(scope="module")
def models(tmp_path_factory, pretender):
    path = tmp_path_factory.mktemp("store") / "data.h5"
    simulate(path, pretender, draw("palpation", pretender.anatomy, 180, 0), {"preset": "palpation"})
    return train(read_dataset(path), ["linear", "svr"]).models


def part_with(part, **changes):
    return ModelPart(part.encoder, part.regressor, Basis(**{**vars(part.basis), **changes}))


def put(array, place, value):
    changed = array.copy()
    changed[place] = value
    return changed


def basis(change):
    return lambda model: replace(
        model, parts=(part_with(model.parts[0], **change(model.parts[0].basis)), *model.parts[1:])
    )


def envelope(**changes):
    return lambda model: replace(model, envelope=replace(model.envelope, **changes))


def encoder(name):
    return lambda model: replace(model, parts=(replace(model.parts[0], encoder=name),))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (basis(lambda b: {"nodes": put(b.nodes, -1, 10**6)}), "nodes lie outside the mesh"),
        (basis(lambda b: {"nodes": put(b.nodes, 0, -1)}), "nodes lie outside the mesh"),
        (basis(lambda b: {"nodes": b.nodes[::-1]}), "not sorted"),
        (basis(lambda b: {"nodes": put(b.nodes, 1, b.nodes[0])}), "come twice"),
        (basis(lambda b: {"nodes": b.nodes.astype(float)}), "no vertex numbers"),
        (basis(lambda b: {"modes": put(b.modes, (0, 0), np.nan)}), "modes are no finite numbers"),
        (basis(lambda b: {"modes": b.modes[:, 3:]}), "modes are not those of its nodes"),
        (basis(lambda b: {"modes": b.modes[1:]}), "gives no result for a load"),
        (lambda model: replace(model, parts=()), "no parts"),
        (
            lambda model: replace(model, parts=(replace(model.parts[0], encoder="magic"),)),
            "no encoder is called 'magic'",
        ),
        (encoder("nodal"), "cannot be read as a model"),
        (lambda model: replace(model, bound=-1.0), "bound is no distance"),
        (envelope(reach=-1.0), "reach is none"),
        (envelope(angle=float("nan")), "angle is none"),
        (envelope(force=(1.0, 0.1)), "range of force is none"),
        (envelope(footprint=(0.0, 0.1)), "range of footprint is none"),
        (envelope(points=np.full((3, 3), np.nan)), "training points are none"),
        (bounds(quantile=lambda q: -q), "bounds are negative"),
        (bounds(quantile=lambda q: q[::-1] * [[2.0], [1.0]]), "shrink with their probability"),
        (bounds(quantile=lambda q: np.full_like(q, np.nan)), "no numbers"),
        (bounds(deviation=lambda d: 0.0 * d), "scale of its bounds"),
        (bounds(weights=lambda w: w[1:]), "another shape"),
    ],
)
def test_a_model_that_cannot_be_is_refused(models, box, tmp_path, change, sentence):
    save(tmp_path / "model.npz", {"svr": change(models["svr"])})
    with pytest.raises(InputError, match=sentence) as caught:
        load(tmp_path / "model.npz", box)
    assert str(caught.value).startswith(str(tmp_path / "model.npz")) and "sulcus train" in str(caught.value)
