"""Comparison of deformers on the page: error for the current load, and error against time."""

from collections.abc import Iterable
from dataclasses import replace

from theatres import short

from scenes.page.comparison import (
    MAX_RECENT_LOADS,
    AccuracyTimeTable,
    Comparison,
    ComparisonRow,
    compare_with_fem,
    format_comparison,
)
from scenes.page.cost_plot import format_cost_plot
from scenes.page.fem_worker import FemResult
from scenes.play.frame_text import describe_outcome
from scenes.play.player import Player
from scenes.play.stage import Stage
from sim.accuracy import LIVE
from sim.deformation import Outcome


def shown(tally: AccuracyTimeTable, name: str, loads: Iterable[str], milliseconds: float, millimetres: float) -> None:
    for load in loads:
        tally.record_time(name, load, 1e-3 * milliseconds)
        tally.record_error(name, load, 1e-3 * millimetres)


def test_deformers_are_ranked_on_common_loads():
    tally = AccuracyTimeTable()
    assert tally.rows == [] and format_cost_plot(tally.rows) == ""
    shown(tally, "quick", "abc", 1.0, 0.2)
    shown(tally, "quick", "z", 90.0, 90.0)  # a load that nobody else had does not count against it
    shown(tally, "slow", "abc", 4.0, 0.03)
    shown(tally, "lost", "bcd", 5.0, 0.2)
    tally.record_time("unjudged", "a", 1e-3)
    rows = [(row.name, round(row.milliseconds, 9), round(row.millimetres, 9), row.loads) for row in tally.rows]
    assert rows == [("quick", 1.0, 0.2, 2), ("slow", 4.0, 0.03, 2), ("lost", 5.0, 0.2, 2)]
    assert [row.is_optimal for row in tally.rows] == [True, True, False]
    words = format_cost_plot(tally.rows)
    assert "over the same 2 loads" in words and words.count("class=best") == 2


def test_deformers_without_common_load_are_not_ranked():
    """One was timed without force, the other at full force: their medians are not comparable."""
    tally = AccuracyTimeTable()
    shown(tally, "resting", "ab", 1.0, 0.002)
    assert [row.is_optimal for row in tally.rows] == [None]
    shown(tally, "pressing", "c", 1.0, 0.2)
    assert [row.is_optimal for row in tally.rows] == [None, None]
    words = format_cost_plot(tally.rows)
    assert "not comparable" in words and "best" not in words


def test_repeated_load_counts_once_and_old_loads_expire():
    tally = AccuracyTimeTable()
    for load in range(MAX_RECENT_LOADS):
        shown(tally, "a", [str(load)], 9.0, 9.0)
    for load in (*range(1000, 1000 + MAX_RECENT_LOADS - 1), 1000, 1000):
        shown(tally, "a", [str(load)], 4.0, 1.0)
    assert tally.rows == [ComparisonRow("a", 4.0, 1.0, MAX_RECENT_LOADS, None)]


def test_error_below_a_micrometre_is_not_printed_as_zero():
    rows = [ComparisonRow("a", 1.0, 4e-4, 3, None), ComparisonRow("b", 1.0, 1.234e-3, 3, None)]
    words = format_cost_plot(rows)
    assert "a: 1.0 ms, error under 0.001 mm" in words and "b: 1.0 ms, error 0.001 mm, 3 loads" in words
    assert "0.000" not in words


class TestVerdict:
    JUDGED = Comparison(28, 0.35, "", 1e-3, 1e-4, 2e-4)

    def test_comparison_for_current_load_is_shown_without_mark(self):
        said = format_comparison(self.JUDGED, False, "waits")
        assert "mean 0.100, maximum 0.200 mm" in said and "stale" not in said and "waits" not in said

    def test_comparison_for_previous_load_is_greyed_and_labelled(self):
        said = format_comparison(self.JUDGED, True, "waits")
        assert said.startswith('<p class="stale">previous load') and "frame 28" in said and "waits" in said

    def test_comparison_warns_when_solver_did_not_converge(self):
        said = [
            format_comparison(replace(self.JUDGED, warning=doubt), False, "waits")
            for doubt in ("", describe_outcome(Outcome.BUDGET))
        ]
        assert ["do not rely on it" in each for each in said] == [False, True]

    def test_empty_comparison_shows_waiting_message(self):
        assert format_comparison(None, True, "waits") == '<p class="stale">waits</p>'


def test_comparison_with_fem_gives_error_in_millimetres(theatre):
    """For a solution with a constant error of 0.2 mm, and for the solution of FEM."""
    scene = short()
    whole = Player(Stage(scene, theatre.site), theatre.build_fem(scene, LIVE))
    loads = whole.build_loads(3)
    answer = whole.compute_deformation(loads)

    class Off:
        def deform(self, loads, start=None, at=None):
            found = whole.deformer.deform(loads, at=at)
            return replace(found, displacement=found.displacement + [0.0, 0.2e-3, 0.0])

    found = compare_with_fem(FemResult(3, loads, answer, 0.5), replace(whole, deformer=Off()), is_fem=False)
    said = format_comparison(found, stale=False, waiting_text="")
    assert "difference from FEM: mean 0.200, maximum 0.200 mm; tip to tumour " in said
    tip = whole.draw_frame(3, whole.get_touch(3), loads, answer, 0.0).distance
    assert f"tip to tumour {1e3 * tip:.1f} mm, tumour moved " in said and "FEM 500 ms" in said
    assert " mm (FEM, without its position error; " in said
    assert format_comparison(found, stale=True, waiting_text="").startswith('<p class="stale">previous load: ')
