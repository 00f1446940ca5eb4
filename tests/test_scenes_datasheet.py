"""Datasheets of episodes."""

from scenes.episodes.exports.datasheet import listed


def test_a_sheet_names_what_is_there_most_often():
    lines = list(listed("tool", ["a", "b", "b", *map(str, range(20))]))
    assert lines[:2] == ["- tool: b (in 2)", "- tool: a (in 1)"] and lines[-1] == "- tool: 10 others (in 10)"
    assert list(listed("tool", ["a"])) == ["- tool: a (in 1)"]
