"""`python -m benchmarks all`: processes of figures, records, tables on pages, and slower numbers."""

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import make_box

from benchmarks.__main__ import main
from benchmarks.figures import figure_runs
from benchmarks.figures.figure_comparison import compare_records
from benchmarks.figures.figure_readings import LIVE, read_number
from benchmarks.figures.figure_record import Entry, Origin, Value, build_record, read_record, write_record
from benchmarks.figures.figure_runs import Run, measure_figure
from benchmarks.figures.figures import NAMED, Figure, format_command
from benchmarks.peers.child_process import ProcessResult, run_command
from sim.bodies.meshfile import write_anatomy

HOUSE = Path(__file__).parents[1]
HERE = Origin("0.1.0 (code 1)", "a machine", "a body", "2026-11-23")


def entry(name="live-cpu", state="measured", origin=HERE, **numbers):
    values = tuple(Value(key.replace("_", " "), number, "ms", "smaller") for key, number in numbers.items())
    return Entry(
        name, format_command(NAMED[name]), state, values, "" if state == "measured" else "it broke", 1.0, origin
    )


def put(path, *entries):
    write_record(path, build_record(HERE, entries))
    return str(path)


@pytest.fixture(scope="module")
def brain(tmp_path_factory):
    """A small box without a tumour: `bench throughput` asks for none, `bench elements` does."""
    path = tmp_path_factory.mktemp("all") / "box.vtu"
    write_anatomy(path, make_box(cells=(6, 6, 3), spacing=12e-3, tumour=0.0, opening=40e-3))
    return path


def test_failed_and_skipped_figures_are_measured_on_resume(brain, tmp_path, capsys, monkeypatch):
    out = tmp_path / "new.json"
    names = ("elements-limit-cpu", "live-cuda", "throughput-cpu")
    for name in names:  # small counts, as nobody waits for more
        small = replace(NAMED[name], command=f"{NAMED[name].command} {NAMED[name].quick_options}")
        monkeypatch.setitem(NAMED, name, small)
    words = ["all", "--json", str(out), "--anatomy", str(brain), "--only", *names]
    assert main(words) == 1
    captured, record = capsys.readouterr(), read_record(out)
    rows = {row.name: row for row in record.rows}
    assert rows["elements-limit-cpu"].state == "failed" and not rows["elements-limit-cpu"].values
    assert re.search("ended with 2: benchmarks elements: the anatomy has no tumour", rows["elements-limit-cpu"].reason)
    assert rows["throughput-cpu"].state == "measured" and rows["throughput-cpu"].seconds > 0.0
    assert {value.name for value in rows["throughput-cpu"].values} == {
        reading.name for reading in NAMED["throughput-cpu"].readings
    }
    assert all(value.value > 0.0 for value in rows["throughput-cpu"].values)
    assert rows["throughput-cpu"].command.endswith("--count 4 --repeats 1 --device cpu")
    assert record.version.startswith("0.") and "cores; Python" in record.machine and record.date.startswith("20")
    assert "throughput-cpu: measured" in captured.err and "| neo-hookean | 0.49 |" in captured.err  # as it goes
    assert "| `elements-limit-cpu` | failed: " in captured.out and "bipolar" in captured.out
    if rows["live-cuda"].state == "skipped":
        assert "no device 'cuda'" in rows["live-cuda"].reason and "| `live-cuda` | skipped: " in captured.out

    assert main([*words, "--tables", str(out)]) == 2  # what is wrong with a page is said before the work
    assert "no page in Markdown" in capsys.readouterr().err
    assert main(words) == 1
    assert "throughput-cpu: kept" in capsys.readouterr().err
    again = {row.name: row for row in read_record(out).rows}
    assert again["throughput-cpu"] == rows["throughput-cpu"]
    assert again["elements-limit-cpu"].seconds != rows["elements-limit-cpu"].seconds


def spoken(figure):
    """What a bench says that has all numbers of a figure."""
    said = {}
    for number, reading in enumerate(figure.readings):
        at = said
        for step, after in zip(reading.place, [*reading.place[1:], None], strict=True):
            if isinstance(step, dict):
                if not (found := [item for item in at if step.items() <= item.items()]):
                    at.append(dict(step))
                at = (found or at)[-1]
            elif after is None:
                at[step] = 1.0 + number
            elif isinstance(step, int):
                at.append({})
                at = at[step]
            else:
                at = at.setdefault(step, {} if isinstance(after, str) else [])
    return json.dumps(said)


@pytest.fixture
def terminable():
    """SIGTERM, which ends no test run: a command that does not hear it fails."""
    before = signal.signal(signal.SIGTERM, lambda number, frame: pytest.fail("SIGTERM was not heard"))
    yield
    signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_run_keeps_its_measurements(number, tmp_path, capsys, monkeypatch, terminable):
    asked = []

    def run(command, folder, heard):
        asked.append(command[3])
        if len(asked) == 2:
            signal.raise_signal(number)
        return ProcessResult(0, spoken(NAMED["live-cpu"]), "", 2.0)

    monkeypatch.setattr(figure_runs, "run_command", run)
    monkeypatch.chdir(tmp_path)
    out = tmp_path / "new.json"
    words = ["all", "--json", str(out), "--only", "live-cpu", "live-linear-cpu"]
    assert main(words) == 130
    assert [row.name for row in read_record(out).rows] == ["live-cpu"] and list(tmp_path.iterdir()) == [out]
    assert "goes on" in capsys.readouterr().err
    assert main(words) == 0 and len(asked) == 3
    assert [value.value for value in read_record(out).rows[1].values] == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert main(words) == 0 and len(asked) == 3
    before = out.read_bytes()
    assert main(["all", "--quick", "--only", "live-cpu"]) == 0 and len(asked) == 4  # small counts are kept nowhere
    assert out.read_bytes() == before and list(tmp_path.iterdir()) == [out] and set(asked) == {"live"}


def test_interrupted_run_ends_its_child_process(tmp_path):
    said = []

    def heard(line):
        said.extend(line.split())
        if said:
            raise KeyboardInterrupt

    script = "import os, sys, time; print(os.getpid(), file=sys.stderr, flush=True); time.sleep(99)"
    with pytest.raises(KeyboardInterrupt):
        run_command((sys.executable, "-c", script), tmp_path, heard)
    assert gone(int(said[0]))


def gone(process):
    """Whether a process ends soon."""
    state, begun = Path(f"/proc/{process}/stat"), time.monotonic()
    while state.exists() and " Z " not in state.read_text():
        if time.monotonic() - begun > 30.0:
            return False
    return True


def said_by(script, figure=NAMED["live-cpu"], before=None, **more):
    """The entry that a process makes which runs a script in place of a bench."""
    code = f"import json, os, signal, sys\n{script}"
    return measure_figure(
        figure, Run("1", "body", command=(sys.executable, "-c", code), **more), before, lambda line: None
    )


@pytest.mark.parametrize(
    ("script", "state", "reason"),
    [
        ("os.kill(os.getpid(), signal.SIGKILL)", "failed", "ended (Killed), as where memory runs out"),
        ("os.kill(os.getpid(), 40)", "failed", "its process was ended (Real-time signal 6)"),
        ("raise RuntimeError('CUDA\\x1b out of memory')", "failed", "ended with 1: RuntimeError: CUDA  out of memory"),
        ("sys.exit(3)", "failed", "ended with 3: it said nothing"),
        ("print('hello')", "failed", "no number for palpation: median, palpation: p99"),
        ("print('[' * 100_000)", "failed", "no number for"),
        ('print(\'{"rides": [{"ride": "palpation", "median": 1e31}]}\')', "failed", "no number for"),
        ("print(json.dumps({'rides': [{'ride': 'palpation', 'median': float('nan')}]}))", "failed", "no number for"),
        ('print(\'{"rides": [{"ride": "palpation", "median": 1e31}]}\')', "failed", "no number for"),
        ("print(json.dumps({'rides': [{'ride': 'palpation', 'median': 2}]}))", "missed", "no number for palpation: p9"),
        ("print('x')\nprint(SAID)", "measured", ""),
        ("print(SAID)\nsys.exit(1)", "missed", "not all that it measures came out as it asks"),
    ],
)
def test_record_entry_states_outcome_and_reason(script, state, reason):
    found = said_by(f"SAID = {spoken(NAMED['live-cpu'])!r}\n{script}")
    assert found.state == state and reason in found.reason and bool(found.reason) == bool(reason)
    assert bool(found.values) == (state in ("measured", "missed"))


def test_benchmark_process_runs_in_a_temporary_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    script = "open('growth.png', 'w'); print(*sys.argv[1:], file=sys.stderr)\nsys.exit(2)"
    found = said_by(script, anatomy=Path("box.vtu"), is_quick=True)
    words = f"live --anatomy {tmp_path}/box.vtu --frames 60 --frames 3 --checked 2 --device cpu --json"
    assert found.reason.endswith(words) and not list(tmp_path.iterdir())
    assert "box.vtu" not in found.command  # of another folder tomorrow


def test_background_children_end_with_their_process(tmp_path):
    script = (
        "import subprocess, sys; print(subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(99)']).pid)"
    )
    ended = run_command((sys.executable, "-c", script), tmp_path, lambda line: None)
    assert ended.code == 0 and ended.seconds < 60.0
    assert gone(int(ended.output))


def test_recorded_entry_is_kept_when_modules_are_missing():
    gone = Figure("live-cpu", "live", "cpu", LIVE, modules=("no_such_module",))
    before = entry(median=3.0, origin=replace(HERE, machine="another"))
    assert said_by("sys.exit(2)", gone, before) is before
    assert said_by("sys.exit(2)", gone).reason.startswith("no_such_module not installed. Install it in the checkout")
    assert said_by("sys.exit(2)", before=before).state == "failed"  # of another machine, so measured anew


def test_figure_number_is_selected_by_the_names_of_its_row():
    said = {"rows": [{"engine": "tled", "x": 1.0}, {"engine": "felupe 11.3", "x": True}, {"engine": "b", "x": -1.0}]}
    assert read_number(said, ("rows", {"engine": "tled"}, "x")) == 1.0
    assert read_number({"rows": [{"engine": "felupe 11.3", "x": 2}]}, ("rows", {"engine": "felupe"}, "x")) == 2.0
    for engine in ("felupe", "b", "tl", "none"):
        assert read_number(said, ("rows", {"engine": engine}, "x")) is None
    assert read_number(said, ("rows", {"engine": "tled"}, "y")) is None and read_number(said, ("rows", 3, "x")) is None
    assert read_number({"rows": 2 * said["rows"]}, ("rows", {"engine": "tled"}, "x")) is None


def test_slower_numbers_are_reported_with_exit_code_1(tmp_path, capsys):
    old = put(tmp_path / "old.json", entry(a=1.0, b=1.0), entry("stages-cpu", a=2.0))
    new = put(tmp_path / "new.json", entry(a=1.2, b=1.05), entry("stages-cpu", a=1.0))
    assert main(["all", "--from", new, "--against", old]) == 1
    said = capsys.readouterr().out
    assert "| live-cpu, a | 1 | 1.2 | ms | **1.20** |" in said and "| stages-cpu, a | 2 | 1 | ms | 0.50 |" in said
    assert said.splitlines()[-1] == "worse by more than 10%: live-cpu, a (1.20 times)" and said.count("worse") == 1
    assert "differs" not in said
    assert main(["all", "--from", new, "--against", new]) == 0
    assert "nothing is worse" in capsys.readouterr().out
    assert main(["all", "--from", new, "--against", old, "--only", "stages-cpu"]) == 0


@pytest.mark.parametrize(
    ("better", "old", "new", "worse"),
    [
        ("smaller", 10.0, 10.9, False),
        ("smaller", 10.0, 11.1, True),
        ("smaller", 10.0, 1.0, False),
        ("smaller", 0.0, 1.0, True),
        ("smaller", 0.0, 0.0, False),
        ("larger", 10.0, 9.2, False),
        ("larger", 10.0, 9.0, True),
        ("larger", 10.0, 90.0, False),
        ("same", 10.0, 9.0, True),
        ("same", 10.0, 11.1, True),
        ("same", 10.0, 10.9, False),
    ],
)
def test_change_above_ten_percent_counts_as_worse(better, old, new, worse):
    before, after = (replace(entry(), values=(Value("x", number, "", better),)) for number in (old, new))
    found = compare_records(build_record(HERE, [before]), build_record(HERE, [after]))
    assert bool(found.regressions) is worse and len(found.changes) == 1


def test_differing_machine_version_and_command_are_reported(tmp_path, capsys):
    elsewhere = replace(HERE, machine="another machine", version="0.0.9")
    other = replace(entry("stages-cpu", a=9.0), command="python -m benchmarks stages slide")
    old = put(tmp_path / "old.json", entry(a=1.0, origin=elsewhere), other, entry("robust-cuda", a=1.0))
    new = put(tmp_path / "new.json", entry(a=1.0), entry("stages-cpu", a=1.0), entry("robust-cuda", "failed"))
    assert main(["all", "--from", new, "--against", old]) == 1
    said = capsys.readouterr().out
    assert "The machine differs. Before: another machine. Now: a machine." in said and "version differs" in said
    assert "stages-cpu is not compared: it was measured by another command" in said
    assert "no longer measured as before: robust-cuda: it broke" in said
    missed = put(tmp_path / "missed.json", entry(a=1.0), entry("robust-cuda", "missed", a=1.0))
    assert main(["all", "--from", missed, "--against", old]) == 1
    assert "no longer measured as before: robust-cuda: it broke" in capsys.readouterr().out
    assert main(["all", "--from", missed, "--against", missed]) == 0
    capsys.readouterr()
    skipped = put(tmp_path / "skipped.json", entry(a=1.0), entry("robust-cuda", "skipped"))
    assert main(["all", "--from", skipped, "--against", old]) == 0
    assert "robust-cuda is not compared: it broke." in capsys.readouterr().out
    apart = put(tmp_path / "apart.json", entry("stages-cpu", a=1.0))
    assert main(["all", "--from", apart, "--against", old]) == 2
    assert re.search("no figure in common.*: measure one of them anew, with the --only", capsys.readouterr().err)


def damaged(whole):
    """Texts that are no record, from one that is."""
    return {
        "cut": whole[: len(whole) // 2],
        "empty": "",
        "deep": "[" * 100_000,
        "list": "[1, 2]",
        "infinite": whole.replace("1.25", "1e999"),
        "nan": whole.replace("1.25", "NaN"),
        "text": whole.replace("1.25", '"1.25"'),
        "another": whole.replace("bench figures 1", "bench figures 9"),
        "bytes": "\x00\x01",
    }


@pytest.mark.parametrize("kind", damaged(""))
def test_damaged_record_gives_one_line_error(kind, tmp_path, capsys):
    good = put(tmp_path / "good.json", entry(a=1.25))
    bad = tmp_path / "bad.json"
    bad.write_text(damaged(Path(good).read_text())[kind])
    for words in (["--from", good, "--against", str(bad)], ["--from", str(bad), "--against", good]):
        assert main(["all", *words]) == 2
        said = capsys.readouterr()
        assert not said.out and said.err.count("\n") == 1 and said.err.startswith(f"benchmarks all: {bad}: ")
    assert main(["all", "--json", str(bad)]) == 2  # nor is it replaced
    assert f"{bad}: " in capsys.readouterr().err


PAGE = "# Page\n\n<!-- bench: live-cpu stages-cpu -->\nold\n<!-- end -->\n\nBy hand: | 1 |\n"


def test_tables_are_rewritten_only_between_markers(tmp_path, capsys):
    page, record = tmp_path / "page.md", put(tmp_path / "new.json", entry(a=0.01234, b=19183.0))
    page.write_text(PAGE)
    words = ["all", "--tables", str(page), "--from", record]
    assert main(words) == 0
    once = page.read_bytes()
    table = (
        "\n| figure | measured | command |\n|---|---|---|\n"
        "| `live-cpu` | a 0.0123 ms; b 19,183 ms | `python -m benchmarks live --frames 60 --device cpu` |\n"
        "| `stages-cpu` | not measured here | `python -m benchmarks stages press --device cpu` |\n\n"
        "Measured on a machine; 2026-11-23.\n\n"
    )
    assert once.decode() == PAGE.replace("old\n", table)
    assert "written" in capsys.readouterr().out
    assert main(words) == 0 and page.read_bytes() == once
    assert "unchanged" in capsys.readouterr().out
    later = entry("stages-cpu", "missed", replace(HERE, date="2026-11-24"), a=1.0)
    assert main([*words[:-1], put(tmp_path / "two.json", entry(a=1.0), later)]) == 0
    text = page.read_text()
    assert "| `stages-cpu` | a 1 ms (it broke) |" in text
    assert "| a machine; 2026-11-23 | `live-cpu` |\n| a machine; 2026-11-24 | `stages-cpu` |\n" in text


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("# None\n", "put these round the table"),
        (PAGE.replace("<!-- end -->", ""), "put these round the table"),
        (PAGE + "<!-- bench: live-cpu -->\n", "put these round the table"),
        (PAGE.replace("<!-- end -->", "") + PAGE, "put these round the table"),
        (PAGE.replace("live-cpu", "lively"), "'lively', which is no figure: choose from throughput-cpu"),
    ],
)
def test_page_with_invalid_markers_is_unchanged(text, reason, tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text(text)
    record = put(tmp_path / "new.json", entry(a=1.0))
    assert main(["all", "--tables", str(page), "--from", record]) == 2
    assert reason in capsys.readouterr().err and page.read_text() == text


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--from", "new.json"], "give --tables or --against"),
        (["--from", "new.json", "--quick", "--against", "new.json"], "--from measures nothing"),
        (["--quick", "--tables", "page.md"], "--quick keeps no figure"),
        (["--json", "new.json", "--against", "new.json"], "is what this command reads"),
        (["--json", "new.txt"], ".json"),
        (["--anatomy", "none.vtu"], "no such file"),
        (["--against", "none.json"], "no such file"),
    ],
)
def test_figure_command_rejects_invalid_input(words, reason, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(figure_runs, "run_command", lambda *asked: pytest.fail("it measures"))
    put(tmp_path / "new.json", entry(a=1.0))
    assert main(["all", *words]) == 2
    assert reason in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["new.json"]


def test_unknown_figure_name_is_rejected(capsys):
    with pytest.raises(SystemExit) as end:
        main(["all", "--only", "lively-cpu"])
    said = capsys.readouterr().err
    assert end.value.code == 2 and "'lively-cpu'" in said and "live-cpu" in said


def test_figures_page_changes_only_between_its_markers(tmp_path):
    page = shutil.copy(HOUSE / "docs/notes/figures.md", tmp_path)
    words = ["--from", put(tmp_path / "new.json", entry(a=1.0))]
    assert main(["all", "--tables", page, *words]) == 0
    before, after = (HOUSE / "docs/notes/figures.md").read_text(), Path(page).read_text()
    outside = [re.sub(r"(<!-- bench.*?-->).*?<!-- end -->", r"\1", text, flags=re.DOTALL) for text in (before, after)]
    assert outside[0] == outside[1] and before != after


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
@pytest.mark.parametrize("words", [["OLD=a.json", "NEW=b.json"], ["a.json", "b.json"]])
def test_make_target_runs_the_figure_comparison(words, tmp_path):
    for name in ("a.json", "b.json"):
        (tmp_path / name).touch()
    make = ["make", "-n", "-f", str(HOUSE / "Makefile"), "-o", ".venv/.installed", "bench-check", *words]
    done = subprocess.run(make, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert ".venv/bin/python -m benchmarks all --against 'a.json' --from 'b.json'\n" in done.stdout
