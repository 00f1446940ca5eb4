"""Accuracy against time, live on the page."""

from collections.abc import Iterable

from scenes.page.tally import RECENT, Row, Tally
from scenes.page.text import table


def shown(tally: Tally, name: str, loads: Iterable[str], milliseconds: float, millimetres: float) -> None:
    for load in loads:
        tally.took(name, load, 1e-3 * milliseconds)
        tally.missed(name, load, 1e-3 * millimetres)


def test_deformers_are_ranked_over_the_loads_that_all_of_them_had():
    tally = Tally()
    assert tally.rows == [] and table(tally.rows) == ""
    shown(tally, "quick", "abc", 1.0, 0.2)
    shown(tally, "quick", "z", 90.0, 90.0)  # a load that nobody else had does not count against it
    shown(tally, "slow", "abc", 4.0, 0.03)
    shown(tally, "lost", "bcd", 5.0, 0.2)
    tally.took("unjudged", "a", 1e-3)
    rows = [(row.name, round(row.milliseconds, 9), round(row.millimetres, 9), row.loads) for row in tally.rows]
    assert rows == [("quick", 1.0, 0.2, 2), ("slow", 4.0, 0.03, 2), ("lost", 5.0, 0.2, 2)]
    assert [row.best for row in tally.rows] == [True, True, False]
    words = table(tally.rows)
    assert "over the same 2 loads" in words and words.count("best") == 2


def test_without_a_common_load_nobody_is_ranked():
    """One on frames without force, the other at full force: the medians are no comparison."""
    tally = Tally()
    shown(tally, "resting", "ab", 1.0, 0.002)
    assert [row.best for row in tally.rows] == [None]
    shown(tally, "pressing", "c", 1.0, 0.2)
    assert [row.best for row in tally.rows] == [None, None]
    words = table(tally.rows)
    assert "not to be compared" in words and "best" not in words


def test_a_load_shown_again_counts_once_and_old_loads_are_forgotten():
    tally = Tally()
    for load in range(RECENT):
        shown(tally, "a", [str(load)], 9.0, 9.0)
    for load in (*range(1000, 1000 + RECENT - 1), 1000, 1000):
        shown(tally, "a", [str(load)], 4.0, 1.0)
    assert tally.rows == [Row("a", 4.0, 1.0, RECENT, None)]


def test_an_error_too_small_to_print_is_not_reported_as_none():
    rows = [Row("a", 1.0, 4e-4, 3, None), Row("b", 1.0, 1.234e-3, 3, None)]
    assert "under 0.001 mm off" in table(rows) and "0.001 mm off</td><td>3 loads" in table(rows)
    assert "0.000" not in table(rows)
