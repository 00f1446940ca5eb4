"""`python -m benchmarks all`: what a record lacks beside another one, or beside a page."""

from dataclasses import replace
from pathlib import Path

from test_benchmarks_figure_record import PAGE, entry, put

from benchmarks.__main__ import main
from benchmarks.figures.figures import NAMED, command_of


def test_what_the_new_record_lacks_is_said(tmp_path, capsys):
    gone = replace(entry(a=1.0), name="a-figure-of-last-year")
    old = put(tmp_path / "old.json", entry(a=1.0, b=1.0), entry("stages-cpu", a=2.0), gone)
    words = ["all", "--against", old, "--from"]
    assert main([*words, put(tmp_path / "fewer.json", entry(a=1.0, b=1.0))]) == 0
    said = capsys.readouterr().out
    for name in ("stages-cpu", "a-figure-of-last-year"):
        assert f"{name} is not compared: the new record does not have it." in said
    assert main([*words, str(tmp_path / "fewer.json"), "--only", "live-cpu"]) == 0
    assert "not compared" not in capsys.readouterr().out
    assert main([*words, put(tmp_path / "part.json", entry(a=1.0), entry("stages-cpu", a=2.0))]) == 1
    assert "no longer measured as before: live-cpu: it has no number for b\n" in capsys.readouterr().out


def test_a_comparison_of_small_counts_says_so(tmp_path, capsys):
    small = replace(entry(a=1.0), command=command_of(NAMED["live-cpu"], quick=True))
    for one, said in ((small, True), (entry(a=1.0), False)):
        path = put(tmp_path / "one.json", one)
        assert main(["all", "--from", path, "--against", path]) == 0
        assert ("--quick, whose times mean nothing" in capsys.readouterr().out) is said


def test_numbers_of_a_page_that_the_record_lacks_stay(tmp_path, capsys):
    page, words = tmp_path / "page.md", ["all", "--tables", str(tmp_path / "page.md"), "--from"]
    page.write_text(PAGE)
    assert main([*words, put(tmp_path / "both.json", entry(a=1.0), entry("stages-cpu", a=2.0))]) == 0
    both = page.read_bytes()
    capsys.readouterr()
    for rows in ([entry(a=3.0)], [entry(a=3.0), entry("stages-cpu", "failed")]):
        one = put(tmp_path / "one.json", *rows)
        assert main([*words, one]) == 2 and page.read_bytes() == both
        assert "has numbers of stages-cpu, and the record has none" in capsys.readouterr().err
    assert main([*words, one, "--force"]) == 0 and "| `stages-cpu` | not measured here |" in page.read_text()
    assert main([*words, one]) == 0


def test_record_of_the_former_command_is_compared(tmp_path, capsys):
    new, old = put(tmp_path / "new.json", entry(a=1.0)), tmp_path / "old.json"
    old.write_text(
        Path(new).read_text().replace("python -m benchmarks live", "sulcus bench live").replace("1.0", "1.2")
    )
    assert "sulcus bench live" in old.read_text()
    assert main(["all", "--from", new, "--against", str(old)]) == 0
    said = capsys.readouterr().out
    assert "| live-cpu, a | 1.2 | 1 |" in said and "another command" not in said
