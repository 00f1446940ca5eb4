"""Seconds by stage: whoever listens hears what lies inside its block."""

import time

import pytest

from sim.runtime.timing import listened, stage


def test_stages_add_up_and_keep_their_order() -> None:
    with listened() as seconds:
        for name in ("mesh", "solve", "mesh"):
            with stage(name):
                time.sleep(0.01)
    assert list(seconds) == ["mesh", "solve"]
    assert seconds["mesh"] >= 0.02 and seconds["solve"] >= 0.01


def test_every_listener_hears_its_own_block() -> None:
    with listened() as outer:
        with stage("before"):
            pass
        with listened() as inner, stage("inside"):
            pass
    with stage("after"):
        pass
    assert list(outer) == ["before", "inside"] and list(inner) == ["inside"]


def test_a_stage_that_fails_is_reported() -> None:
    with pytest.raises(KeyError), listened() as seconds, stage("lost"):
        raise KeyError
    assert list(seconds) == ["lost"]
