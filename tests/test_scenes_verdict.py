"""The verdict on an answer: the error of the present load, and how it is said."""

from dataclasses import replace

from theatres import short

from scenes.page.referee import Truth
from scenes.page.verdict import Judged, judge, verdict_words
from scenes.play.load_text import doubt_of
from scenes.play.player import Player
from scenes.play.stage import Stage
from sim.accuracy import LIVE
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


def test_a_verdict_is_the_error_in_millimetres(theatre):
    """Of a model whose answer is 0.2 mm off everywhere, and of the finite elements' own distance."""
    scene = short()
    whole = Player(Stage(scene, theatre.site), theatre.fem(scene, LIVE))
    loads = whole.loads(3)
    answer = whole.answer(loads)

    class Off:
        def deform(self, loads, start=None, at=None):
            found = whole.deformer.deform(loads, at=at)
            return replace(found, displacement=found.displacement + [0.0, 0.2e-3, 0.0])

    found = judge(Truth(3, loads, answer, 0.5), replace(whole, deformer=Off()), own=False)
    said = verdict_words(found, stale=False, waits="")
    assert "error against FEM: mean 0.200, largest 0.200 mm; tip to tumour " in said
    tip = whole.drawn(3, whole.touch(3), loads, answer, 0.0).distance
    assert f"tip to tumour {1e3 * tip:.1f} mm, tumour moved " in said and "FEM 500 ms" in said
    assert " by FEM, without the error of the tumour (" in said
    assert verdict_words(found, stale=True, waits="").startswith('<p class="stale">of an earlier load: ')
