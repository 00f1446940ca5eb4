"""Command line: help of each command, rejected input, and the start of `sulcus demo`."""

import os
import subprocess
import sys
import threading
from dataclasses import replace

import pytest
from boxes import base_held
from boxes import box as cube
from programs import main
from theatres import put, theatre_of
from visitor import free_port

from benchmarks.__main__ import BENCHMARKS
from scenes.cli import COMMANDS, limit_threads
from scenes.page.demo import Demo
from scenes.page.scene_solvers import SceneSolvers
from scenes.play.waiting_notice import WaitingNotice
from sim.bodies.meshfile import write_anatomy, write_mesh


def test_help_of_commands_does_not_import_warp_or_scipy():
    """Importing them takes a second."""
    code = (
        "import sys; from scenes.cli import make_parsers\n"
        "for name in sys.argv[1:]:\n"
        "    make_parsers(name)[1][name].format_help()\n"
        "    assert not {'warp', 'scipy', 'torch'} & set(sys.modules), name\n"
    )
    commands = ["demo", "render", "check", "effects", "collect", "judge", "export", "sensitivity"]
    done = subprocess.run([sys.executable, "-c", code, *commands], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", ["linear", "fem"])
def test_demo_page_opens_during_compilation_and_then_plays(name, box, tmp_path, monkeypatch):
    """Preparation includes the first prediction of a model."""
    done, predicted = [], SceneSolvers.predict
    opened = threading.Event()

    def slow():
        assert opened.wait(30.0)
        done.append("compiled")

    monkeypatch.setattr("ar.overlay.composite.load_kernels", slow)
    monkeypatch.setattr(WaitingNotice, "begin_work", lambda busy, what: done.append(what) or opened.set())
    monkeypatch.setattr(SceneSolvers, "predict", lambda *words: done.append("answered") or predicted(*words))
    monkeypatch.setattr(Demo, "run", lambda page, seconds: done.append("plays"))
    path = put(theatre_of(box), tmp_path / "box.vtu")
    assert main(["demo", "--anatomy", str(path), "--deformer", name, "--port", str(free_port())]) == 0
    waits = "compiling; the next start finds it done"
    assert done == [waits, "compiled", *(["answered"] if name == "linear" else []), "plays"]


@pytest.mark.parametrize(
    ("cores", "said", "most"), [(64, None, "4"), (2, None, "2"), (64, "7", "7"), (None, None, "1")]
)
def test_limit_threads_keeps_limits_of_the_environment(monkeypatch, cores, said, most):
    monkeypatch.setattr("os.cpu_count", lambda: cores)
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
    for name in names:
        monkeypatch.setenv(name, said or "")
        if said is None:
            monkeypatch.delenv(name)
    limit_threads()
    assert [os.environ[name] for name in names] == [most, most]


@pytest.mark.parametrize(
    "words",
    ["render x --out o", "collect x --out o.h5", "film x --out o", "demo x", "check press x", "effects x", "budget x",
     "uncertainty press x", "benchmarks frame x", "benchmarks stages x"],
)  # fmt: skip
def test_unknown_scene_is_rejected_before_anatomy_opens(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([*words.split(), "--anatomy", "no.vtu"]) == 2
    assert "no scene is called 'x'" in capsys.readouterr().err
    assert main(["warp", "no.vtu", "--scene", "x", "--frame-number", "1", "--out", "o"]) == 2
    assert "no scene is called 'x'" in capsys.readouterr().err and not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def folder(box, tmp_path_factory):
    """box.vtu with its models; other.vtu with the models of box; mesh.vtu, a mesh; closed.vtu, without opening."""
    folder = tmp_path_factory.mktemp("commands")
    theatre = theatre_of(box)
    put(theatre, folder / "box.vtu")
    put(theatre, folder / "other.vtu")
    write_anatomy(folder / "other.vtu", replace(box, fixed=box.fixed | True))
    write_mesh(folder / "mesh.vtu", box.mesh, {})
    write_anatomy(folder / "closed.vtu", base_held(cube((2, 2, 2))))
    for name in ("text.npz", "text.vtu"):
        (folder / name).write_text("no model")
    return folder


PLAYING = {
    "demo": ["demo", "press", "--seconds", "1"],
    "render": ["render", "press", "--out", "frames"],
    "collect": ["collect", "press", "--out", "press.h5"],
    "check": ["check", "press"],
    "stages": ["benchmarks", "stages", "press"],
}
ALL = [
    (["--anatomy", "none.vtu"], "no such file"),
    (["--anatomy", "text.npz"], "no mesh is read from .npz"),
    (["--anatomy", "text.vtu"], "cannot be read"),
    (["--anatomy", "mesh.vtu"], "not an anatomy"),
    (["--anatomy", "closed.vtu"], "no open cortex"),
    (["--anatomy", "other.vtu"], "was trained on"),
    (["--anatomy", "box.vtu", "--model", "none.npz"], "no such file"),
    (["--anatomy", "box.vtu", "--model", "text.npz"], "cannot be read as a model"),
    (["--anatomy", "box.vtu", "--device", "abacus"], "no device 'abacus'"),
]
DEFORMER = (["--anatomy", "box.vtu", "--deformer", "oracle"], "'oracle' here: choose one of linear, svr, guarded, fem")
OWN = [
    ("render", ["--every", "0"], "--every is 0"),
    ("render", ["--every", "-3"], "--every is -3"),
    ("render", ["--film", "film.avi"], ".mp4"),
    ("render", ["--film", "box.vtu/film.mp4"], "folder"),
    ("render", ["--out", "box.vtu"], "is a file"),
    ("render", ["--out", "box.vtu/frames"], "cannot be written"),
    ("collect", ["--out", "press.txt"], ".h5"),
    ("collect", ["--out", "box.vtu/press.h5"], "folder"),
    ("check", ["--every", "0"], "--every is 0"),
    ("demo", ["--port", "70000"], "70000 is no port"),
    ("demo", ["--port", "-1"], "-1 is no port"),
    ("demo", ["--host", "no.such.host.invalid"], "no.such.host.invalid"),
    ("demo", ["--seconds", "nan"], "--seconds nan"),
    ("stages", ["--batch", "0"], "--batch is 0"),
    ("stages", ["--solves", "0"], "count"),
]
CASES = [
    *((PLAYING[name] + words, reason) for name in PLAYING for words, reason in ALL),
    *((PLAYING[name] + DEFORMER[0], DEFORMER[1]) for name in PLAYING),
    *((PLAYING[name] + ["--anatomy", "box.vtu", *words], reason) for name, words, reason in OWN),
    *((["dance" if word == "press" else word for word in words], "'dance'") for words in PLAYING.values()),
]


@pytest.mark.parametrize(("words", "reason"), CASES, ids=[" ".join(words) for words, _ in CASES])
def test_commands_reject_bad_input_and_write_nothing(folder, monkeypatch, capsys, words, reason):
    monkeypatch.chdir(folder)
    before = {path: path.stat().st_mtime_ns for path in sorted(folder.rglob("*"))}
    assert main(words) == 2
    out, error = capsys.readouterr()
    sentence = error.splitlines()[-1]
    program = f"benchmarks {words[1]}" if words[0] == "benchmarks" else f"sulcus {words[0]}"
    assert reason in sentence and sentence.startswith(f"{program}: ") and sentence.endswith(".")
    assert "Traceback" not in error and "address" not in out
    assert {path: path.stat().st_mtime_ns for path in sorted(folder.rglob("*"))} == before


@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_prints_its_help(name, capsys):
    with pytest.raises(SystemExit) as end:
        main([name, "--help"])
    out = capsys.readouterr().out
    assert end.value.code == 0 and COMMANDS[name][1:20] in " ".join(out.split())


@pytest.mark.parametrize("words", [[], ["dance"], ["check", "--every", "often"], ["collect", "press"]])
def test_unknown_command_is_rejected_with_usage(words, capsys):
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 2 and "usage: sulcus" in capsys.readouterr().err


@pytest.mark.parametrize("words", [[], ["throughput", "--count", "4"], ["--help"]])
def test_bench_command_names_its_replacement(words, capsys):
    assert main(["bench", *words]) == 2
    said = capsys.readouterr().err
    assert "`python -m benchmarks NAME`" in said and said.count("\n") == 1


def test_benchmarks_help_lists_every_name(capsys):
    with pytest.raises(SystemExit) as end:
        main(["benchmarks", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert end.value.code == 0 and all(f"{name} {text[:20]}" in said for name, text in BENCHMARKS.items())
