"""`python -m benchmarks all`: figures missing from a record, and former command names."""

from dataclasses import replace
from pathlib import Path

from test_benchmarks_figure_record import entry, put

from benchmarks.__main__ import main


def test_missing_figures_of_new_record_are_reported(tmp_path, capsys):
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


def test_record_of_former_command_name_is_compared(tmp_path, capsys):
    new, old = put(tmp_path / "new.json", entry(a=1.0)), tmp_path / "old.json"
    old.write_text(
        Path(new).read_text().replace("python -m benchmarks live", "sulcus bench live").replace("1.0", "1.2")
    )
    assert "sulcus bench live" in old.read_text()
    assert main(["all", "--from", new, "--against", str(old)]) == 0
    said = capsys.readouterr().out
    assert "| live-cpu, a | 1.2 | 1 |" in said and "another command" not in said
