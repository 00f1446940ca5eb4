"""Accuracy against time, live on the page."""

from scenes.pareto import unbeaten
from scenes.tally import RECENT, Tally


def test_the_front_is_whom_nobody_beats_in_both():
    places = {"a": (1.0, 5.0), "b": (2.0, 2.0), "c": (2.5, 2.0), "d": (9.0, 1.0), "e": (2.0, 2.0)}
    assert unbeaten(places) == {"a", "b", "d", "e"}
    assert unbeaten({}) == frozenset()


def test_medians_of_the_last_frames_fastest_first_and_the_front_in_bold():
    tally = Tally()
    assert str(tally) == ""
    for _ in range(RECENT):
        tally.took("slow", 9.0)  # seconds that must be forgotten
    for seconds in [4e-3] * RECENT + [1.0] * 3:
        tally.took("slow", seconds)
    tally.took("quick", 1e-3)
    tally.took("lost", 5e-3)
    tally.took("unjudged", 1e-3)
    for name, metres in (("slow", 1e-5), ("slow", 3e-5), ("slow", 8e-5), ("quick", 2e-4), ("lost", 2e-4)):
        tally.missed(name, metres)
    assert {name: (round(ms, 9), round(mm, 9)) for name, (ms, mm) in tally.places.items()} == {
        "slow": (4.0, 0.03),
        "quick": (1.0, 0.2),
        "lost": (5.0, 0.2),
    }
    told = str(tally).partition("): ")[2]
    assert told.split(" · ") == ["**quick** 1.0 ms, 0.200 mm", "**slow** 4.0 ms, 0.030 mm", "lost 5.0 ms, 0.200 mm"]
