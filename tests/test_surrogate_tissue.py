"""Fitted tissue: random draws from it, and its file."""

import numpy as np
import pytest

from scenes.script.priors import sample_from_fit
from sim.errors import InputError
from sim.material import BRAIN
from surrogate.fitting.tissue import FINE_POISSONS, FINE_RATIOS, FittedTissue, load_tissue, save_tissue


def test_sampled_tissues_follow_the_fitted_shares():
    share = np.zeros((3, 13, 33))
    share[0, 3, 20], share[1, 3, 20], share[1, 9, 30] = 0.25, 0.25, 0.5
    tissue = FittedTissue("", 4, share, np.array([1500.0]))
    names, poisson, ratio = tissue.sample(400, 1)
    assert names.count("bonded") == 100 and (ratio == FINE_RATIOS[30]).sum() == 200
    assert ((poisson == FINE_POISSONS[9]) == (ratio == FINE_RATIOS[30])).all()
    draws = sample_from_fit(tissue, BRAIN, ("slide", "contact"), 30, 2)
    assert {draw.stiffness for draw in draws} == {0.5} and all(draw.skull == 0.25 for draw in draws)
    stiff = sample_from_fit(tissue, BRAIN, ("slide", "contact"), 30, 2, tumour_ratio=2.0)
    assert [draw.ratio for draw in stiff] == [draw.ratio / 2.0 for draw in draws]  # of a tumour that is stated as such
    with pytest.raises(InputError, match="cannot have"):
        sample_from_fit(tissue, BRAIN, ("contact",), 8)


def test_tissue_file_round_trips_and_rejects_other_anatomy(tmp_path):
    share = np.random.default_rng(0).uniform(size=(3, 13, 33))
    tissue = FittedTissue("abc", 4, share / share.sum(), np.array([1500.0, 2000.0]))
    path = tmp_path / "brain.tissue.json"
    save_tissue(path, tissue)
    again = load_tissue(path, "abc")
    assert again.ratio == tissue.ratio and again.stiffness == tissue.stiffness and again.frames == 4
    with pytest.raises(InputError, match="another anatomy"):
        load_tissue(path, "abd")
    path.write_text(path.read_text().replace("[[[", "[[[-", 1))
    with pytest.raises(InputError, match="no probabilities"):
        load_tissue(path, "abc")
