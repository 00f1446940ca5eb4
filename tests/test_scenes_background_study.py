import threading

from scenes.page.background_study import BackgroundStudy
from sim.errors import InputError


def test_a_study_shows_each_text_and_starts_again():
    shown, turn = [], threading.Lock()
    study = BackgroundStudy(lambda: iter(["one", "two"]), turn, shown.append)
    for _ in range(2):
        study.start()
        study.thread.join(10.0)
    assert shown == ["one", "two"] * 2 and not turn.locked()


def test_a_closed_study_shows_nothing_more():
    shown = []

    def work():
        yield "one"
        study.close()
        yield "two"

    study = BackgroundStudy(work, threading.Lock(), shown.append)
    study.start()
    study.thread.join(10.0)
    assert shown == ["one"]


def test_bad_input_is_shown_as_a_warning():
    def work():
        raise InputError("a < b")
        yield ""

    shown = []
    study = BackgroundStudy(work, threading.Lock(), shown.append)
    study.start()
    study.thread.join(10.0)
    assert shown == ['<p class="warn">a &lt; b</p>']
