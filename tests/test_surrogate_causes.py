"""Causes of an ensemble: random draws, and skull models in which they are solved."""

from dataclasses import replace

import numpy as np
import pytest
from test_surrogate_locator import FEW

from surrogate.locating.causes import SEPARATING_SKULL, build_drainages, build_groups, build_pushes


def test_draws_depend_only_on_seed_and_group(body):
    first, second = build_groups(body, 0, FEW)[:2]
    draws = [(first, 0), (first, 0), (second, 0), (first, 1)]
    force, again, other, later = (build_pushes(group, body, seed, FEW).causes[0].force for group, seed in draws)
    assert np.array_equal(force, again) and not np.array_equal(force, other) and not np.array_equal(force, later)
    falling = build_drainages(first, body, 0, FEW)
    assert [len(level) for level in falling] == [3, 3]
    down = [level.causes[1].direction for level in falling]
    assert np.array_equal(*down) and (falling[1].causes[1].csf_level < falling[0].causes[1].csf_level).all()


def test_separating_skull_excludes_nearly_incompressible_tissue(body):
    made = {(group.skull, group.poisson) for group in build_groups(body, 0, FEW)}
    assert (SEPARATING_SKULL, 0.45) in made and (SEPARATING_SKULL, 0.485) not in made and ("slide", 0.485) in made


def test_each_skull_model_has_soft_and_stiff_tumours(body):
    """Each third of the range has one for every seed; at small strain tissues have the parameters of their group."""
    for seed in range(20):
        for skull in ("bonded", "slide"):
            some = [
                group
                for group in build_groups(body, seed, replace(FEW, poisson=(0.45, 0.47, 0.49)))
                if group.skull == skull
            ]
            for name, (low, high) in (("ratio", FEW.stiffness), ("exponent", FEW.exponent)):
                share = [np.log(getattr(group, name) / low) / np.log(high / low) for group in some]
                assert np.floor(3.0 * np.sort(share)).tolist() == [0.0, 1.0, 2.0], (seed, skull, name)
    elasticity = some[0].build_effects(FEW.swellings)[0]
    (mu, lam), (hard, _) = elasticity.default.lame, elasticity.regions[2].lame
    assert lam / (2.0 * (lam + mu)) == pytest.approx(0.45) and hard / mu == pytest.approx(some[0].ratio)
    assert elasticity.default.terms[0][1] == -some[0].exponent
