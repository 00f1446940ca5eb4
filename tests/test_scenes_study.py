"""Recorded time of a step: unknown if its file is damaged."""

import pytest

from scenes.report.study import note_seconds, read_noted_seconds


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"seconds": "many"}', b"\xff"])
def test_damaged_time_file_gives_unknown_seconds(tmp_path, content):
    made = tmp_path / "made.npz"
    note_seconds(made, 1.25)
    assert read_noted_seconds(made) == 1.25
    made.with_suffix(".json").write_bytes(content)
    assert read_noted_seconds(made) is None
