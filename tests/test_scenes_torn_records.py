"""Records that grow line by line: a line cut short, or a file of another kind, is a sentence; no number is guessed."""

import pytest

from benchmarks.studies.recorded_rows import append_rows, read_rows
from benchmarks.studies.robustness import Record
from benchmarks.studies.scaling import Row
from scenes.report.artefact_time import note_seconds, noted_seconds
from sim.errors import InputError

RECORDS = [
    Record(
        preset="mixed",
        number=number,
        force=1.5,
        footprint=0.006,
        outcome="CONVERGED",
        outer=4,
        residual=1e-5,
        double=1e-5,
        seconds=12.75,
    )
    for number in range(3)
]


def test_a_number_cut_short_is_not_read(tmp_path):
    path = tmp_path / "loads.csv"
    append_rows(path, "this trial", RECORDS)
    assert read_rows(path, "this trial", Record) == RECORDS
    whole = path.read_bytes()
    path.write_bytes(whole[:-3])  # 12.7 would be a number too
    with pytest.raises(InputError, match="last line is not whole: remove that line"):
        read_rows(path, "this trial", Record)
    path.write_bytes(whole.replace(b"CONVERGED,4", b"CONVERGED,four", 1))
    with pytest.raises(InputError, match="line 3 is not whole"):
        read_rows(path, "this trial", Record)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00binary", b"", b"\n\n", b"[" * 10**5])
def test_files_of_another_kind_are_sentences(tmp_path, content):
    path = tmp_path / "record"
    path.write_bytes(content)
    for kind in (Record, Row):
        with pytest.raises(InputError, match=r"[cC]hoose another --out"):
            read_rows(path, "this trial", kind)


def test_a_row_that_is_none_is_named(tmp_path):
    path = tmp_path / "growth.csv"
    path.write_text("# this trial\nsize,asked\n" + "[" * 10**5 + "\n")
    with pytest.raises(InputError, match="line 3 is not whole"):
        read_rows(path, "this trial", Row)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"seconds": "many"}', b"\xff"])
def test_what_a_step_took_is_unknown_where_its_file_is_damaged(tmp_path, content):
    made = tmp_path / "made.npz"
    note_seconds(made, 1.25)
    assert noted_seconds(made) == 1.25
    made.with_suffix(".json").write_bytes(content)
    assert noted_seconds(made) is None
