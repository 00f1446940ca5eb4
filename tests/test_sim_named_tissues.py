"""Named tissues: sources, time scales and published constants; the measured brain against the data it is fitted to."""

import pytest

from sim.material import MEASURED_BRAIN, Ogden
from sim.named_tissues import MATERIALS


@pytest.mark.parametrize("name", MATERIALS)
def test_named_tissues_have_time_scale_stiffness_and_source(name: str) -> None:
    known = MATERIALS[name]
    assert any(word in known.time_scale for word in ("second", "minutes", "hours", "no fluid leaves"))
    assert len(known.source) > 20
    mu, lam = known.tissue.lame
    assert 300.0 < mu < 3000.0  # brain tissue
    assert 0.44 < lam / (2.0 * (lam + mu)) < 0.5


def test_named_tissues_use_published_shear_moduli() -> None:
    """Ogden's mu of 670 Pa before 2 mu / alpha^2 is a shear modulus."""
    minutes = MATERIALS["minutes"].tissue
    assert isinstance(minutes, Ogden)
    assert minutes.lame[0] == pytest.approx(670.0)
    assert (minutes.bulk, minutes.terms[0][1]) == (148e3, -19.0)
    assert MATERIALS["seed"].tissue.lame[0] == pytest.approx(1114.0, abs=1.0)


def test_measured_brain_is_between_grey_and_white_matter() -> None:
    grey, white = (MATERIALS[name].tissue.lame[0] for name in ("grey", "white"))
    assert white < MEASURED_BRAIN.lame[0] < grey
    assert MATERIALS["brain"].tissue == MEASURED_BRAIN
    assert MEASURED_BRAIN.poisson == pytest.approx(0.49)
