"""Tissue laws of users: checked against the requirements of a law, and solved like built-in ones."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp
from oracle import EVERY_LAW, tissue
from test_sim_user_script import BODY, PRESS, TWO, YEOH, answer

from sim.accuracy import TRAIN
from sim.effects import Elasticity, Held, ToolForce, has_history
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads
from sim.material import Material, Ogden
from sim.terms.laws.conformance import check_tissue
from sim.terms.laws.law import Law

YEOHS = Ogden(((1500.0, 2.0), (500.0, 2.0)), 1e4)


class TestLaw:
    @pytest.mark.parametrize("element", ["p1", "smoothed", "p2"])
    def test_user_law_agrees_with_equal_built_in_law(self, element):
        """Yeoh without c2 is Ogden's law with m = 2, in as many terms as other tests compile it with."""
        own = answer(Elasticity(YEOH.Yeoh(500.0, 0.0, 1e4)), element=element)
        known = answer(Elasticity(YEOHS), element=element)
        assert np.abs(known).max() > 2e-3
        assert np.abs(own - known).max() < 1e-6 * np.abs(known).max()

    def test_user_law_stiffens_with_its_second_constant(self):
        soft, stiff = (answer(Elasticity(YEOH.Yeoh(500.0, c2, 1e4))) for c2 in (0.0, 5e3))
        ratio = np.abs(stiff).max(axis=(1, 2)) / np.abs(soft).max(axis=(1, 2))
        assert ratio[0] < 0.95 < 0.99 < ratio[1] < 1.0  # the second load is a quarter of the first

    def test_user_law_mixes_with_built_in_law_by_region(self):
        own, known = YEOH.Yeoh(500.0, 0.0, 1e4), YEOHS
        other = Material("neo-hookean", 6000.0, 0.4)
        mixed = [answer(Elasticity(law, {1: other}), body=TWO, element="smoothed") for law in (own, known)]
        assert np.abs(mixed[0] - mixed[1]).max() < 1e-6 * np.abs(mixed[1]).max()

    def test_user_law_with_prony_series_relaxes(self):
        class Relaxing(YEOH.Yeoh):
            law = "relaxing yeoh"
            prony = ((0.5, 1.0),)

        fem = Fem(BODY, (Elasticity(Relaxing(500.0, 500.0, 1e4)), Held(), ToolForce()), TRAIN, "cpu", element="p1")
        assert has_history(fem.effects)
        at_once = fem.deform(Loads(PRESS.causes, np.zeros(2)))
        later = fem.deform(Loads(PRESS.causes, np.full(2, 3.0)), start=at_once)
        assert np.abs(later.displacement).max() > 1.2 * np.abs(at_once.displacement).max()

    @pytest.mark.parametrize("law", EVERY_LAW)
    def test_built_in_law_passes_check_for_user_laws(self, law):
        found = check_tissue(tissue(law), small_strain=law == "linear")
        assert len(found) > 12 and all(finding.is_within_limit for finding in found)

    def test_example_law_passes_check_and_linear_law_fails(self):
        assert all(finding.is_within_limit for finding in check_tissue(YEOH.SOFT))
        with pytest.raises(InputError, match=r"the law linear does not hold: stress turns with the tissue: relative"):
            check_tissue(tissue("linear"))

    @pytest.mark.parametrize(
        ("broken", "words"),
        [
            ({"stress": "half"}, "Hooke's law at small strain.*stress is the energy's derivative"),
            ({"stress_change": "half"}, "does not hold: stress_change is the stress's derivative: relative error 1.0e"),
            ({"needs_positive_volume": False}, "relative error (nan|inf)"),
        ],
    )
    def test_broken_law_is_rejected_and_violated_property_named(self, broken, words):
        own_stress, own_change = YEOH.stress, YEOH.stress_change

        @wp.func
        def half_stress(H: Any, c: Any):
            return own_stress(H, c) / type(c[0])(2.0)

        @wp.func
        def half_change(H: Any, D: Any, c: Any):
            return own_change(H, D, c) / type(c[0])(2.0)

        halves = {"stress": half_stress, "stress_change": half_change}
        made = replace(YEOH.Yeoh.functions, **{k: halves[k] if v == "half" else v for k, v in broken.items()})

        class Broken(YEOH.Yeoh):
            law = "broken"
            functions = made

        with pytest.raises(InputError, match=words):
            check_tissue(Broken(500.0, 1500.0, 1e4))

    def test_wrong_law_constants_are_rejected_with_reason(self):
        class Wrong(YEOH.Yeoh):
            def coefficients_at(self, mu, lam):
                return mu, self.c2, lam

        with pytest.raises(InputError, match=r"Hooke's law at small strain"):
            check_tissue(Wrong(500.0, 1500.0, 1e4))

        class Longer(YEOH.Yeoh):
            @property
            def coefficients(self):
                return 1.0, 2.0

        with pytest.raises(InputError, match=r"2 coefficients, but 3 at other Lamé parameters"):
            check_tissue(Longer(500.0, 1500.0, 1e4))
        with pytest.raises(InputError, match=r"Lamé constants -2.0"):
            check_tissue(YEOH.Yeoh(-1.0, 0.0, 1e4))

    def test_value_that_is_not_a_tissue_law_is_rejected(self):
        with pytest.raises(InputError, match=r"str is no tissue: it has no law, functions.*Give a Material, an Ogden"):
            Elasticity("jelly")  # pyright: ignore[reportArgumentType]

    def test_two_laws_with_the_same_name_are_rejected(self):
        class Other(YEOH.Yeoh):
            functions = Law("yeoh", YEOH.energy, YEOH.stress, YEOH.stress_change)

        with pytest.raises(InputError, match=r"two tissue laws are called 'yeoh'"):
            answer(Elasticity(YEOH.SOFT, {1: Other(500.0, 0.0, 1e4)}), body=TWO)
