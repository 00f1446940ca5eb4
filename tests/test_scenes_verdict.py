"""The verdict on an answer: the error of the present load, and how it is said."""

from dataclasses import replace

from scenes.page.verdict import Judged, verdict_words
from scenes.play.load_text import doubt_of
from sim.deformation import Outcome


class TestVerdict:
    JUDGED = Judged(28, 0.35, "", 1e-3, 1e-4, 2e-4)

    def test_of_the_present_load_it_stands_plainly(self):
        said = verdict_words(self.JUDGED, False, "waits")
        assert "mean 0.100, largest 0.200 mm" in said and "stale" not in said and "waits" not in said

    def test_of_another_load_it_is_greyed_and_says_so(self):
        said = verdict_words(self.JUDGED, True, "waits")
        assert said.startswith('<p class="stale">of an earlier load') and "frame 28" in said and "waits" in said

    def test_an_answer_short_of_its_tolerance_is_not_relied_on(self):
        said = [
            verdict_words(replace(self.JUDGED, doubt=doubt), False, "waits") for doubt in ("", doubt_of(Outcome.BUDGET))
        ]
        assert ["do not rely on it" in each for each in said] == [False, True]

    def test_before_any_it_says_what_is_waited_for(self):
        assert verdict_words(None, True, "waits") == '<p class="stale">waits</p>'
