"""Page server with several visitors and their inputs; a visitor is a plain web socket."""

import re
import time
import urllib.request

import cv2
import numpy as np
import pytest
from visitor import Visitor, free_port, wait_for

from ar.page.access_guard import DEFAULT_LIMITS, ConnectionLimits
from ar.page.browser import Browser
from ar.page.elements import PICTURE, SAID, SLICES, STYLE_KEY, keep_numbers_together, to_data_url
from ar.page.parts import Dropdown, Folder, Note, Playback, SceneLabel, SceneSurface, SceneViewpoint, Slider, Toggle
from ar.page.recording import RECORD_LABEL, STOP_LABEL
from ar.page.style import NOTE, PAGE, STATUS, build_style

TRIANGLE = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]])


@pytest.fixture
def heard():
    return {"force": [], "deformer": [], "play": [], "frame": []}


def open_page(heard, port, host="127.0.0.1", limits=DEFAULT_LIMITS) -> Browser:
    bodies = [
        SceneSurface("tumour", TRIANGLE, np.array([[0, 1, 2]]), (0.2, 0.9, 0.3)),
        SceneSurface("brain", TRIANGLE, np.array([[0, 1, 2]]), opacity=0.3),
    ]
    return Browser(
        bodies,
        SceneViewpoint(np.array([0.0, -0.3, 0.2]), np.zeros(3), np.array([0.0, 0.0, 1.0])),
        Playback(100, heard["play"].append, heard["frame"].append),
        [
            Dropdown("deformer", ("FEM", "ANN"), "ANN", heard["deformer"].append, key=STYLE_KEY),
            Slider("force [N]", 0.0, 1.0, 0.01, 0.2, heard["force"].append),
        ],
        host=host,
        port=port,
        size=(64, 48),
        signs=[SceneLabel("R", np.array([0.1, 0.0, 0.0]))],
        limits=limits,
    )


@pytest.fixture
def page(heard):
    page = open_page(heard, free_port())
    yield page
    page.close()


def test_page_is_served_as_html(page):
    with urllib.request.urlopen(page.address) as answer:
        assert answer.status == 200 and b"<html" in answer.read().lower()


def test_address_contains_the_given_host(heard):
    """A page bound to one interface is not available at localhost."""
    page = open_page(heard, free_port(), host="127.0.0.2")
    assert page.address.startswith("http://127.0.0.2:")
    with urllib.request.urlopen(page.address) as answer:
        assert answer.status == 200
    page.close()


def test_occupied_port_selects_another_port(page, heard):
    second = open_page(heard, int(page.address.rsplit(":", 1)[1]))
    assert second.address != page.address
    with urllib.request.urlopen(second.address) as answer:
        assert answer.status == 200
    second.close()


def test_page_sends_latest_frame_and_updates_slider(page, heard):
    for number in range(50):
        page.show(number, np.full((48, 64, 3), number, np.uint8), f"frame {number}")
    assert wait_for(lambda: int(page.frame.value) == 49)
    assert (page.shown[1] == 49).all()
    assert heard["frame"] == []


def test_image_and_text_are_sent_in_one_update(page):
    """A slow browser shows image and text of the same frame; new text is sent with its image."""
    visitor = Visitor(page, 1600)
    assert wait_for(lambda: page.visitors == 1)
    pictures = [np.full((48, 64, 3), number, np.uint8) for number in range(40)]
    for number, picture in enumerate(pictures):
        page.show(number, picture, f"said of frame {number}")
        time.sleep(0.02)
    page.report("said later")

    def sights() -> list[str]:
        return [each["content"] for each in visitor.updates if "sulcus-next" in each.get("content", "")]

    assert wait_for(lambda: "said later" in "".join(sights()))
    visitor.wire.close()
    assert len(sights()) > 3
    numbers = [int(re.findall(r'data-number="(\d+)"', each)[0]) for each in sights()]
    assert numbers == sorted(set(numbers))
    for each in sights()[:-1]:
        number = int(re.findall(r"said of frame&nbsp;(\d+)", each)[0])
        assert to_data_url(pictures[number]) in each
    assert to_data_url(pictures[39]) in sights()[-1]
    assert not any("said" in str(each) for each in visitor.updates if "sulcus-next" not in str(each))


def test_unchanged_frame_is_not_sent_again(page):
    """A paused page repeats its frame thirty times a second; the slider stays free for the visitor."""
    visitor, picture = Visitor(page, 1600), np.full((48, 64, 3), 7, np.uint8)
    page.show(7, picture, "said")
    assert wait_for(lambda: page.visitors == 1 and int(page.frame.value) == 7)
    time.sleep(0.3)
    before = len(visitor.updates)
    for _ in range(20):
        page.show(7, picture, "said")
        time.sleep(0.02)
    time.sleep(0.2)
    assert len(visitor.updates) == before
    visitor.wire.close()


def test_page_updates_vertices_report_and_input_value(page):
    page.move("tumour", TRIANGLE + 0.01)
    page.report("render <b>12 ms</b>")
    page.put("force [N]", 0.35)
    assert wait_for(lambda: page.inputs["force [N]"].value == 0.35 and "<b>12 ms</b>" in page.shown[2])
    assert np.allclose(page.meshes["tumour"].vertices, TRIANGLE + 0.01)


def test_move_of_unknown_body_raises_key_error(page):
    with pytest.raises(KeyError):
        page.move("liver", TRIANGLE)


def test_several_visitors_receive_frames_and_send_inputs(page, heard):
    wide, narrow = Visitor(page, 1600), Visitor(page, 420)
    assert wait_for(lambda: page.visitors == 2)
    assert wait_for(lambda: wide.received > 0 and narrow.received > 0)
    time.sleep(0.3)
    before = wide.received, narrow.received
    page.show(7, np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8), "")
    assert wait_for(lambda: wide.received > before[0] + 1000 and narrow.received > before[1] + 1000)
    wide.set(page.inputs["force [N]"], 0.4)
    assert wait_for(lambda: heard["force"] == [0.4])
    wide.wire.close()
    assert wait_for(lambda: page.visitors == 1)
    narrow.set(page.inputs["deformer"], "FEM")
    narrow.set(page.frame, 31)
    assert wait_for(lambda: heard["deformer"] == ["FEM"] and heard["frame"] == [31])
    narrow.wire.close()


def test_only_the_first_visitor_controls_the_page(page, heard):
    """Others may request control; the leader grants it, and it passes on when the leader leaves."""
    first, second = Visitor(page, 1600), Visitor(page, 420)
    page.show_line(lambda visitor: f"number {visitor}")
    assert wait_for(lambda: set(page.crowd.rows) == {0, 1} and page.crowd.rows[1].request_button.visible)
    leads, looks = (page.crowd.rows[number] for number in (0, 1))
    assert "You have control" in leads.line.content and "Visitor 1 has control" in looks.line.content
    assert "number 2" in looks.line.content and not leads.dim_style.content and "opacity" in looks.dim_style.content
    second.set(page.inputs["force [N]"], 0.4)
    second.set(page.button, True)
    second.hit(page.controls.commands[0])
    assert wait_for(lambda: second.updates and page.inputs["force [N]"].value == 0.2)
    first.set(page.frame, 12)
    assert wait_for(lambda: heard["frame"] == [12]) and heard["force"] == [] and heard["play"] == []
    second.set(looks.request_button, True)
    page.show_line(lambda visitor: "")
    assert wait_for(lambda: page.crowd.lead.queue == (2,))
    page.show_line(lambda visitor: "")
    assert wait_for(lambda: leads.release_button.visible and "Visitor 2 requests control" in leads.line.content)
    assert not looks.request_button.visible
    first.set(leads.release_button, True)
    assert wait_for(lambda: page.crowd.lead.holder == 2)
    first.set(page.frame, 13)
    second.set(page.frame, 14)
    assert wait_for(lambda: heard["frame"] == [12, 14])
    second.wire.close()
    assert wait_for(lambda: page.visitors == 1)
    first.set(page.frame, 15)
    assert wait_for(lambda: heard["frame"] == [12, 14, 15])
    first.wire.close()


def test_hotkeys_play_step_and_select_deformer(heard):
    page = open_page(heard, free_port())
    visitor = Visitor(page, 1200)
    assert wait_for(lambda: page.visitors == 1)
    page.show(7, np.full((48, 64, 3), 7, np.uint8), "")
    assert wait_for(lambda: page.shown[0] == 7)
    keys = {command.hotkey: command for command in page.controls.commands}
    for key, frames in (("arrowright", [8]), ("arrowleft", [8, 6])):
        visitor.hit(keys[key])
        assert wait_for(lambda frames=frames: heard["frame"] == frames)
    assert heard["play"] == [False, False]
    visitor.hit(keys["space"])
    assert wait_for(lambda: heard["play"] == [False, False, True])
    visitor.hit(keys["S"])
    assert wait_for(lambda: heard["deformer"] == ["FEM"] and page.inputs["deformer"].value == "FEM")
    visitor.wire.close()
    page.close()


def test_recording_is_downloaded_as_one_video(page, monkeypatch):
    """Only the visitor who started it receives it, and none does if that visitor has left."""
    sent: list[tuple] = []
    monkeypatch.setattr("viser.ClientHandle.send_file_download", lambda client, *file, **how: sent.append(file))
    visitor, button = Visitor(page, 1200), page.recorder.button
    assert wait_for(lambda: page.visitors == 1) and button is not None
    visitor.set(button, True)
    assert wait_for(lambda: button.label == STOP_LABEL)
    for number in range(10):
        page.show(number, np.full((48, 64, 3), 20 * number, np.uint8), "")
        time.sleep(0.1)
    visitor.set(button, True)
    assert wait_for(lambda: len(sent) == 1 and button.label == RECORD_LABEL)
    name, film = sent[0]
    assert name == "sulcus.mp4" and b"ftyp" in film[:16]
    visitor.set(button, True)
    assert wait_for(lambda: page.recorder.recording is not None)
    visitor.wire.close()
    assert wait_for(lambda: page.visitors == 0)
    page.show(3, np.full((48, 64, 3), 3, np.uint8), "")
    assert wait_for(lambda: page.recorder.recording is None and button.label == RECORD_LABEL) and len(sent) == 1


def test_slices_and_history_are_sent_together_at_limited_rate(page):
    drawn: list[int] = []

    def draw(number: int) -> tuple[np.ndarray, str]:
        drawn.append(number)
        return np.full((20, 60, 3), number, np.uint8), f"seconds of {number}"

    page.show_side_panels(lambda: draw(1))
    time.sleep(0.3)
    assert not drawn  # nobody looks
    visitor, begun = Visitor(page, 1200), time.monotonic()
    assert wait_for(lambda: page.visitors == 1)
    for number in range(40):
        page.show_side_panels(lambda number=number: draw(number))
        time.sleep(0.02)
    assert wait_for(lambda: "seconds of 39" in page.beside.content)
    assert drawn[-1] == 39 and len(drawn) <= 2 + DEFAULT_LIMITS.slice_updates_per_second * (time.monotonic() - begun)
    assert to_data_url(np.full((20, 60, 3), 39, np.uint8)) in page.beside.content and SLICES in page.beside.content
    visitor.wire.close()


def test_user_input_has_priority_over_page_updates(heard):
    page = open_page(heard, free_port(), limits=ConnectionLimits(updates_per_second=2000.0))
    visitor = Visitor(page, 1200)
    assert wait_for(lambda: page.visitors == 1)
    sought = list(range(50, 100)) * 4
    for place, number in enumerate(sought):
        page.show(place % 50, np.zeros((48, 64, 3), np.uint8), "")
        visitor.set(page.frame, number)
        time.sleep(1e-3)
    assert wait_for(lambda: len(heard["frame"]) == len(sought))
    assert heard["frame"] == sought
    visitor.wire.close()
    page.close()


def test_play_button_toggles_playback(page, heard):
    visitor = Visitor(page, 900)
    assert wait_for(lambda: page.visitors == 1)
    for wanted in ([False], [False, True]):
        visitor.set(page.button, True)
        assert wait_for(lambda wanted=wanted: heard["play"] == wanted)
    visitor.wire.close()


def test_value_set_by_program_triggers_no_callback(page, heard):
    page.put("force [N]", 0.5)
    assert wait_for(lambda: page.inputs["force [N]"].value == 0.5)
    time.sleep(0.2)
    assert heard["force"] == []


def test_fill_replaces_bodies_and_controls(page, heard):
    """A new scene replaces bodies and controls, and pending updates of the old ones are dropped."""
    visitor = Visitor(page, 1200)
    assert wait_for(lambda: page.visitors == 1)
    old = page.inputs["force [N]"]
    page.put("force [N]", 0.9)
    hidden: list[bool] = []
    fold = Folder("more", (Toggle("Gravity", True, hidden.append, "gravity and fluid", "off?"),))
    body = SceneSurface("blade", TRIANGLE, np.array([[0, 1, 2]]))
    page.fill(
        [body], Playback(30, heard["play"].append, heard["frame"].append), [fold], "sulcus: retract", "<p>seen</p>"
    )
    assert set(page.inputs) == {"Gravity"} and set(page.meshes) == {"blade"} and page.frame.max == 29
    assert "<p>seen</p>" in page.words.content and page.inputs["Gravity"].label == "gravity and fluid"
    with pytest.raises(KeyError):
        page.move("tumour", TRIANGLE)
    visitor.set(old, 0.4)
    visitor.set(page.inputs["Gravity"], False)
    assert wait_for(lambda: hidden == [False])
    assert heard["force"] == []
    page.show(3, np.full((48, 64, 3), 3, np.uint8), "")
    assert wait_for(lambda: int(page.frame.value) == 3)
    visitor.wire.close()


def test_save_button_downloads_the_displayed_image(page, monkeypatch):
    sent: list[tuple] = []
    monkeypatch.setattr("viser.ClientHandle.send_file_download", lambda client, *file, **how: sent.append(file))
    shown = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    page.show(7, shown, "")
    assert wait_for(lambda: int(page.frame.value) == 7)
    visitor = Visitor(page, 1200)
    assert wait_for(lambda: page.visitors == 1)
    visitor.set(page.saver, True)
    assert wait_for(lambda: len(sent) == 1)
    name, content = sent[0]
    saved = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    assert saved is not None and name == "sulcus-7.png" and np.array_equal(saved[..., ::-1], shown)
    visitor.wire.close()


def test_save_button_precedes_the_controls(page):
    after = [handle.order for handle in page.inputs.values()]
    assert page.frame.order < page.saver.order < min(after)


def test_phone_layout_puts_distance_and_playback_first(page):
    """One column: the report (scrolls in a low window), then controls, then descriptions."""
    assert page.folder is not None
    assert page.text.order < page.folder.order < page.words.order
    # The distance, and eight lines more: whom to trust, what acts, and the verdict even on an earlier load.
    phone, low = build_style(4 / 3).split("@media (max-width: 36em)")[1:]
    (size,) = map(float, re.findall(rf"#{SAID} {{ font-size: ([0-9.]+)rem }}", phone))
    (high,) = map(float, re.findall(rf"#{SAID} {{ max-height: ([0-9.]+)rem; overflow-y: auto;", low))
    assert high >= 1.25 * 1.4 + 8 * 1.4 * size
    page.fill([], Playback(30, print, print), [Slider("force [N]", 0.0, 1.0, 0.01, 0.2, print)])
    assert page.folder.order < page.words.order


def test_number_and_unit_are_joined_by_nonbreaking_space():
    kept = keep_numbers_together('<p style="top: 3 px">in 4.72 mm (95 %)')
    assert kept == '<p style="top: 3 px">in&nbsp;4.72&nbsp;mm (95&nbsp;%)'


def test_wide_window_shows_controls_in_two_columns(page):
    """All controls are visible at 1280 x 720, and the text above them spans both columns."""
    wide = build_style(4 / 3).split("@media (min-width: 75em) and (min-aspect-ratio: 13/10) {")[1].split("@media")[0]
    holder = f"div:has(> div > #{SAID})"
    assert 75 * 16 <= 1280 and f"{holder} {{ display: grid; grid-template-columns: 1fr 1fr;" in wide
    assert wide.index(f"{holder} > * {{ grid-column: 1 / -1 }}") < wide.index(f"{holder} > div:has(> button)")


def test_status_line_is_shown_and_cleared(page):
    page.show_status("solving ... 3 s")
    assert wait_for(lambda: "<span>solving ... 3 s</span>" in page.line.content)
    page.show_status("")
    assert wait_for(lambda: page.line.content == "")


def test_status_line_does_not_cover_the_header():
    (rule,) = re.findall(rf"#{STATUS} {{ position: fixed; (.*?) }}", build_style(4 / 3))
    assert "right: calc(100vw - var(--w)" in rule and "left:" not in rule


def test_note_is_visible_only_with_text(page):
    page.fill([], Playback(30, print, print), [Note("how"), Note("why", "<p>known</p>")])
    folder, text = page.controls.notes["how"]
    assert (
        not folder.visible
        and page.controls.notes["why"][0].visible
        and "<p>known</p>" in page.controls.notes["why"][1].content
    )
    assert not folder.expand_by_default
    page.write("how", "<ul><li>first</ul>")
    assert wait_for(lambda: folder.visible and "<ul><li>first</ul>" in text.content)
    page.write("how", "")
    assert wait_for(lambda: not folder.visible)


def test_play_button_label_follows_playback_state(page):
    page.show_playback(False)
    assert wait_for(lambda: page.button.label == "Play")
    page.show_playback(True)
    assert wait_for(lambda: page.button.label == "Pause")


def test_tint_changes_the_colour_of_a_body(page):
    page.tint("tumour", (0.5, 0.0, 1.0))
    assert wait_for(lambda: tuple(page.meshes["tumour"].color) == (128, 0, 255))


def test_style_sheet_uses_image_shape_and_page_elements(page):
    sheet = build_style(4 / 3)
    assert "--aspect: 1.3333" in sheet and sheet.startswith("<style>") and sheet.count("{") == sheet.count("}")
    assert f".{NOTE}" in sheet
    for name in (PAGE, PICTURE, SAID, STATUS):
        assert f"#{name}" in sheet
    assert PAGE in page.words.content and SAID in page.text.content
