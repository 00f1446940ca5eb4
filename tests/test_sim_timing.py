"""Seconds by stage: a listener records the stages inside its block."""

import time

import pytest

from sim.runtime.timing import listen_to_stages, time_stage


def test_stages_add_up_and_keep_their_order() -> None:
    with listen_to_stages() as seconds:
        for name in ("mesh", "solve", "mesh"):
            with time_stage(name):
                time.sleep(0.01)
    assert list(seconds) == ["mesh", "solve"]
    assert seconds["mesh"] >= 0.02 and seconds["solve"] >= 0.01


def test_every_listener_records_its_own_block() -> None:
    with listen_to_stages() as outer:
        with time_stage("before"):
            pass
        with listen_to_stages() as inner, time_stage("inside"):
            pass
    with time_stage("after"):
        pass
    assert list(outer) == ["before", "inside"] and list(inner) == ["inside"]


def test_stage_that_fails_is_recorded() -> None:
    with pytest.raises(KeyError), listen_to_stages() as seconds, time_stage("lost"):
        raise KeyError
    assert list(seconds) == ["lost"]
