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


def test_background_study_shows_each_text_and_restarts():
    shown, turn = [], threading.Lock()
    study = BackgroundStudy(lambda: iter(["one", "two"]), turn, shown.append)
    for _ in range(2):
        study.start()
        study.thread.join(10.0)
    assert shown == ["one", "two"] * 2 and not turn.locked()


@pytest.mark.parametrize("fails", [False, True])
def test_closed_background_study_shows_no_further_text(fails):
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


def test_background_study_shows_input_error_as_warning():
    def work():
        raise InputError("a < b")
        yield ""

    shown = []
    study = BackgroundStudy(work, threading.Lock(), shown.append)
    study.start()
    study.thread.join(10.0)
    assert shown == ['<p class="warn">a &lt; b</p>']


def test_effect_costs_change_labels_of_existing_switches():
    button, none = SimpleNamespace(label=""), cast("Any", None)
    page = Mock(controls=SimpleNamespace(handles={"Gravity": button}), store_update=lambda key, send: send())
    page.rename = partial(Browser.rename, page)
    costs, _ = build_studies(none, none, none, threading.Lock(), lambda: page)
    costs.show({EFFECT_COSTS: "note", "Gravity": "gravity: +1 ms", "ToolForce": "of another scene"})
    page.write.assert_called_once_with(EFFECT_COSTS, "note")
    assert button.label == "gravity: +1 ms"
