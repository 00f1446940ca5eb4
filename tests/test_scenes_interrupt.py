"""Signals end `sulcus demo` during a long solve."""

import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from scenes.commands.interrupt import interrupt_on_termination, run_until_signal

COMMAND = """
import argparse, sys, threading, time
from types import SimpleNamespace as Names

class Demo:
    def __init__(self, *words, **named):
        self.browser = Names(address="here", addresses=(), token=None)
        self.busy, self.cast = Names(begin_work=len), Names(predict=lambda *asked: None)
        self.solve = threading.Thread(target=time.sleep, args=(100.0,), daemon=True)
        self.solve.start()

    def run(self, seconds):
        print("playing", flush=True)
        getattr(self, sys.argv[1])()

    def computing(self):
        self.solve.join()

    def ending(self):
        self.solve = threading.Thread(target=print)
        self.solve.start()

    def close(self):
        print("page closed", flush=True)
        self.solve.join()
        print("all closed", flush=True)

theatre = Names(models={"linear": Names(bound=1e-4, held_out=None)}, learned_tissue=None, anatomy=Names(mesh=None),
                select_best=lambda scene: "linear", select_default=lambda scene: "linear",
                select_default_scene=lambda: "none",
                select_models=lambda scene: True, list_rejections=lambda scene: {},
                describe_deformer=lambda name, scene: name)
sys.modules["ar.overlay.composite"] = Names(load_kernels=lambda: None)
sys.modules["sim.runtime.device"] = Names(find_device=lambda *words: None)
sys.modules["scenes.page.demo"] = Names(Demo=Demo)
scene = Names(name="none", viewpoint=None, deformer=None, elasticity=Names(default=None, regions={}),
              replace_tissue=lambda tissue, element: scene, replace_regions=lambda regions: scene)
sys.modules["scenes.script.scene"] = Names(find_scene=lambda name: scene, SCENES=("none",), check_scene_exists=len)
sys.modules["scenes.play.deformers"] = Names(open_theatre=lambda *words: theatre)
from scenes.commands.demo import add_arguments, run
parser = argparse.ArgumentParser()
add_arguments(parser)
sys.exit(run(parser.parse_args(["--port", "0"])))
"""


def started(what):
    command = [sys.executable, "-c", COMMAND, what]
    root = Path(__file__).parents[1]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=root)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_signal_closes_the_page_without_waiting_for_solver(number, code):
    """Page and FEM worker are in a solve of 100 s; the test's time limit is far shorter."""
    process = started("computing")
    try:
        assert process.stdout is not None and any("playing" in line for line in process.stdout)
        process.send_signal(number)
        out, error = process.communicate(timeout=20)
    finally:
        process.kill()
    assert process.returncode == code
    assert "page closed" in out and "all closed" not in out and error == ""


def test_finished_demo_closes_all_resources():
    out, error = (process := started("ending")).communicate(timeout=60)
    assert process.returncode == 0 and "all closed" in out and error == ""


def test_error_is_raised_and_signal_handlers_are_restored():
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    closed = []

    def work(closing: ExitStack) -> int:
        closing.callback(closed.append, True)
        raise TimeoutError("too late")

    with pytest.raises(TimeoutError, match="too late"):
        run_until_signal(work)
    assert closed == [True]
    assert run_until_signal(lambda closing: 7) == 7
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_inside_a_finaliser_is_raised_later(number):
    class Signalling:
        def __del__(self):
            signal.raise_signal(number)

    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(KeyboardInterrupt), interrupt_on_termination() as stop_if_asked:
        stop_if_asked()
        Signalling()
        went_on = True
        stop_if_asked()
    assert went_on
    with pytest.raises(KeyboardInterrupt), interrupt_on_termination():  # and if nobody asks, repeated
        Signalling()
        time.sleep(20.0)
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before
