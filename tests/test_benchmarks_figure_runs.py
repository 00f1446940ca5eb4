"""`python -m benchmarks all --quick`: what small counts measured neither replaces figures nor reaches a page."""

from dataclasses import replace

from benchmarks.__main__ import main
from benchmarks.figures.figure_record import Entry, Origin, Value, read_record, record_of, write_record
from benchmarks.figures.figures import NAMED, command_of

HERE = Origin("0.1.0 (code 1)", "a machine", "a body", "2026-11-23")
WHOLE = Entry(
    "live-cpu", command_of(NAMED["live-cpu"]), "measured", (Value("median", 9.0, "ms", "smaller"),), "", 1.0, HERE
)
QUICK = replace(WHOLE, command=command_of(NAMED["live-cpu"], quick=True))


def put(path, entry):
    write_record(path, record_of(HERE, [entry]))
    return str(path)


def test_an_entry_knows_whether_its_counts_were_small():
    assert QUICK.quick and not WHOLE.quick
    same = NAMED["elements-limit-cpu"]  # has no small counts
    assert not replace(WHOLE, name=same.name, command=command_of(same, quick=True)).quick


def test_small_counts_do_not_reach_a_page(tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text("<!-- bench: live-cpu -->\n<!-- end -->\n")
    words = ["all", "--tables", str(page), "--from"]
    assert main([*words, put(tmp_path / "whole.json", WHOLE)]) == 0
    text = page.read_text()
    assert main([*words, put(tmp_path / "quick.json", QUICK)]) == 2
    assert "live-cpu was measured with --quick, whose times mean nothing" in capsys.readouterr().err
    assert page.read_text() == text and "9 ms" in text


def test_small_counts_do_not_replace_what_was_measured_in_full(tmp_path, capsys):
    record = tmp_path / "whole.json"
    assert main(["all", "--quick", "--only", "live-cpu", "--json", put(record, WHOLE)]) == 2
    assert "holds live-cpu as measured in full" in capsys.readouterr().err
    assert read_record(record).rows == (WHOLE,)
