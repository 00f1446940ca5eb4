"""The page: served, shared by several visitors, told what they do. A visitor here is a bare web socket."""

import time
import urllib.request

import numpy as np
import pytest
from visitor import Visitor, free_port, wait_for

from ar.browser import Body, Browser, Choice, Playback, Slider, Viewpoint

TRIANGLE = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]])


@pytest.fixture
def told() -> dict[str, list]:
    return {"force": [], "deformer": [], "play": [], "frame": []}


def open_page(told: dict[str, list], port: int, host: str = "127.0.0.1") -> Browser:
    bodies = [
        Body("tumour", TRIANGLE, np.array([[0, 1, 2]]), (0.2, 0.9, 0.3)),
        Body("brain", TRIANGLE, np.array([[0, 1, 2]]), opacity=0.3),
    ]
    return Browser(
        bodies,
        Viewpoint(np.array([0.0, -0.3, 0.2]), np.zeros(3), np.array([0.0, 0.0, 1.0])),
        Playback(100, told["play"].append, told["frame"].append),
        [
            Choice("deformer", ("FEM", "ANN"), "ANN", told["deformer"].append),
            Slider("force [N]", 0.0, 1.0, 0.01, 0.2, told["force"].append),
        ],
        host=host,
        port=port,
        size=(64, 48),
    )


@pytest.fixture
def page(told):
    page = open_page(told, free_port())
    yield page
    page.close()


def test_the_page_is_served(page):
    with urllib.request.urlopen(page.address) as answer:
        assert answer.status == 200 and b"<html" in answer.read().lower()


def test_the_address_names_the_host_that_serves(told):
    """A page on one interface is not to be found at localhost."""
    page = open_page(told, free_port(), host="127.0.0.2")
    assert page.address.startswith("http://127.0.0.2:")
    with urllib.request.urlopen(page.address) as answer:
        assert answer.status == 200
    page.close()


def test_a_port_that_is_taken_is_left_to_its_owner(page, told):
    second = open_page(told, int(page.address.rsplit(":", 1)[1]))
    assert second.address != page.address
    with urllib.request.urlopen(second.address) as answer:
        assert answer.status == 200
    second.close()


def test_only_the_newest_picture_is_sent_and_the_slider_follows(page, told):
    for number in range(50):
        page.show(number, np.full((48, 64, 3), number, np.uint8))
    assert wait_for(lambda: int(page.frame.value) == 49)
    assert (page.picture.image == 49).all()
    assert told["frame"] == []


def test_bodies_move_and_reports_change(page):
    page.move("tumour", TRIANGLE + 0.01)
    page.report("render **12 ms**")
    page.put("force [N]", 0.35)
    assert wait_for(lambda: page.inputs["force [N]"].value == 0.35 and page.text.content == "render **12 ms**")
    assert np.allclose(page.meshes["tumour"].vertices, TRIANGLE + 0.01)


def test_an_unknown_body_is_an_error_at_once(page):
    with pytest.raises(KeyError):
        page.move("liver", TRIANGLE)


def test_several_visitors_see_the_page_and_are_heard(page, told):
    wide, narrow = Visitor(page, 1600), Visitor(page, 420)
    assert wait_for(lambda: page.visitors == 2)
    assert wait_for(lambda: wide.received > 0 and narrow.received > 0)
    time.sleep(0.3)
    before = wide.received, narrow.received
    page.show(7, np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8))
    assert wait_for(lambda: wide.received > before[0] + 1000 and narrow.received > before[1] + 1000)
    wide.set(page.inputs["force [N]"], 0.4)
    narrow.set(page.inputs["deformer"], "FEM")
    narrow.set(page.frame, 31)
    assert wait_for(lambda: told["force"] == [0.4] and told["deformer"] == ["FEM"] and told["frame"] == [31])
    wide.wire.close()
    assert wait_for(lambda: page.visitors == 1)
    narrow.wire.close()


def test_what_a_visitor_sets_is_heard_while_the_page_sets_the_same(told, monkeypatch):
    monkeypatch.setattr("ar.browser.PICTURES_PER_SECOND", 2000.0)
    page = open_page(told, free_port())
    visitor = Visitor(page, 1200)
    assert wait_for(lambda: page.visitors == 1)
    sought = list(range(50, 100)) * 4
    for place, number in enumerate(sought):
        page.show(place % 50, np.zeros((48, 64, 3), np.uint8))
        visitor.set(page.frame, number)
        time.sleep(1e-3)
    assert wait_for(lambda: len(told["frame"]) == len(sought))
    assert told["frame"] == sought
    visitor.wire.close()
    page.close()


def test_the_button_pauses_and_plays(page, told):
    visitor = Visitor(page, 900)
    assert wait_for(lambda: page.visitors == 1)
    for wanted in ([False], [False, True]):
        visitor.set(page.button, True)
        assert wait_for(lambda wanted=wanted: told["play"] == wanted)
    visitor.wire.close()


def test_scripts_do_not_take_over_from_themselves(page, told):
    page.put("force [N]", 0.5)
    assert wait_for(lambda: page.inputs["force [N]"].value == 0.5)
    time.sleep(0.2)
    assert told["force"] == []
