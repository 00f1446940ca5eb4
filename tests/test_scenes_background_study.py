import threading
from functools import partial
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import pytest

from ar.page.browser import Browser
from scenes.page.background_study import BackgroundStudy, build_studies
from scenes.page.effect_costs import EFFECT_COSTS
from sim.errors import InputError


def test_a_study_shows_each_text_and_starts_again():
    shown, turn = [], threading.Lock()
    study = BackgroundStudy(lambda: iter(["one", "two"]), turn, shown.append)
    for _ in range(2):
        study.start()
        study.thread.join(10.0)
    assert shown == ["one", "two"] * 2 and not turn.locked()


@pytest.mark.parametrize("fails", [False, True])
def test_a_closed_study_shows_nothing_more(fails):
    shown = []

    def work():
        yield "one"
        study.close()
        if fails:
            raise InputError("late")
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


def test_costs_rename_the_switches_that_the_page_has():
    button, none = SimpleNamespace(label=""), cast("Any", None)
    page = Mock(controls=SimpleNamespace(handles={"Gravity": button}), note=lambda key, send: send())
    page.rename = partial(Browser.rename, page)
    costs, _ = build_studies(none, none, none, threading.Lock(), lambda: page)
    costs.show({EFFECT_COSTS: "note", "Gravity": "gravity: +1 ms", "ToolForce": "of another scene"})
    page.write.assert_called_once_with(EFFECT_COSTS, "note")
    assert button.label == "gravity: +1 ms"
