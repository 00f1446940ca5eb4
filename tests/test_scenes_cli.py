"""`sulcus demo` from its start to the first picture."""

import os
import subprocess
import sys
import threading

import pytest
from theatres import put, theatre_of
from visitor import free_port

from scenes.cli import limit_threads, main
from scenes.page.demo import Demo
from scenes.page.scene_solvers import SceneSolvers
from scenes.play.waiting_notice import Busy


def test_help_texts_come_without_warp_and_scipy():
    """They take a second to import."""
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
def test_page_opens_during_compilation_then_plays(name, box, tmp_path, monkeypatch):
    """A model's first answer belongs to what is made ready."""
    done, predicted = [], SceneSolvers.predict
    opened = threading.Event()

    def slow():
        assert opened.wait(30.0)
        done.append("compiled")

    monkeypatch.setattr("ar.overlay.composite.load_kernels", slow)
    monkeypatch.setattr(Busy, "begin_work", lambda busy, what: done.append(what) or opened.set())
    monkeypatch.setattr(SceneSolvers, "predict", lambda *words: done.append("answered") or predicted(*words))
    monkeypatch.setattr(Demo, "run", lambda page, seconds: done.append("plays"))
    path = put(theatre_of(box), tmp_path / "box.vtu")
    assert main(["demo", "--anatomy", str(path), "--deformer", name, "--port", str(free_port())]) == 0
    waits = "compiling; the next start finds it done"
    assert done == [waits, "compiled", *(["answered"] if name == "linear" else []), "plays"]


@pytest.mark.parametrize(
    ("cores", "said", "most"), [(64, None, "4"), (2, None, "2"), (64, "7", "7"), (None, None, "1")]
)
def test_libraries_use_few_threads_unless_somebody_asks_for_more(monkeypatch, cores, said, most):
    monkeypatch.setattr("os.cpu_count", lambda: cores)
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
    for name in names:
        monkeypatch.setenv(name, said or "")
        if said is None:
            monkeypatch.delenv(name)
    limit_threads()
    assert [os.environ[name] for name in names] == [most, most]
