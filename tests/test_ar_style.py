"""Page in a real browser: layout at four sizes, registration with the server's image, and keys."""

import threading

import pytest
from chromium import PROGRAM, SIZES, Chromium, assert_fits, assert_in_register, box_of
from theatres import Silent, small, theatre_of
from visitor import free_port, wait_for

from ar.page.elements import HELP, HISTORY, PICTURE, SAID, SLICES, TABS
from scenes.page.demo import Demo
from scenes.page.requests import HAND
from scenes.script.tool_paths import press

LOADED = f"document.querySelector('#{PICTURE} img') && document.querySelector('#{SLICES} img')"
FRAME = "document.querySelector('[aria-label=frame][role=slider]')"

pytestmark = pytest.mark.skipif(PROGRAM is None, reason="there is no Chromium here")


@pytest.fixture(scope="module")
def demo(box):
    """A page that has played up to frame 40 and is paused."""
    scene = small(path=press(0.3, rise=1.0, hold=1.0), duration=2.0, frames_per_second=60.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scenes.page.scene_solvers.FemWorker", Silent)
        demo = Demo(theatre_of(box), scene, "linear", "127.0.0.1", free_port())
        demo.wish.set(plays=False, number=40)
        done = threading.Event()

        def play():
            while not done.is_set():
                demo.run(0.3)

        loop = threading.Thread(target=play)
        loop.start()
        assert wait_for(lambda: "Tumour position error" in demo.browser.shown[2])
        yield demo
        done.set()
        loop.join()
        demo.close()


@pytest.fixture(scope="module")
def window(demo):
    window = Chromium()
    window.open(demo.browser.address, *SIZES[0])
    assert window.wait(LOADED) and window.wait(FRAME)
    yield window
    window.close()


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
def test_page_fits_the_window_and_matches_server_image(demo, window, size):
    """No element is cut off, both errors are visible, and the image equals the server's to one pixel."""
    window.size(*size)
    said = f"document.getElementById('{SAID}')"
    assert window.wait(f"innerWidth == {size[0]} && {said}.innerText.includes('motion error')")
    assert_fits(window, size, ("surrogate error", "motion error"))
    assert_in_register(window, demo.browser.shown[1])
    track = box_of(window, f"{FRAME}?.closest('.mantine-Slider-root')")
    assert track[2] - track[0] > 150.0 and track[2] <= size[0]
    for number, place in ((1, SLICES), (2, HISTORY)):
        window.value(f"document.getElementById('{TABS[number][1]}').click()")
        part = box_of(window, f"document.querySelector('#{place} > *')")
        assert part[0] >= 0 and part[2] <= size[0] and part[3] <= size[1] and part[2] - part[0] > 200.0
    assert window.errors == []


def test_physics_switches_are_visible_in_a_low_window(demo, window):
    """The folded section is above the 3-D view, with room for five lines."""
    window.size(1280, 720)
    fold = (
        "[...document.querySelectorAll('legend, span, div')].findLast(e => e.innerText?.startsWith('physics effects'))"
    )
    window.value(f"document.getElementById('{TABS[0][1]}').click()")
    assert window.wait(f"innerWidth == 1280 && {fold}?.offsetHeight > 0")
    view = box_of(window, "document.querySelector('canvas')")
    assert box_of(window, fold)[3] + 5 * 16 <= view[1]


def test_keyboard_controls_and_accessible_names_work(demo, window):
    """Keys step, select and open their list; a slider keeps its own keys; every control has a name."""
    window.size(1280, 720)
    demo.wish.set(plays=False, number=40)
    assert wait_for(lambda: demo.browser.shown[0] == 40)
    assert wait_for(lambda: window.value("document.querySelectorAll('[role=slider]:not([aria-label])').length") == 0)
    window.press("ArrowRight", "ArrowRight")
    assert wait_for(lambda: demo.wish.number == 41 and demo.browser.shown[0] == 41)
    window.press("ArrowLeft", "ArrowLeft")
    assert wait_for(lambda: demo.browser.shown[0] == 40)
    shown = "getComputedStyle(document.querySelector('#sulcus-said .details')).display"
    assert window.value(shown) == "none"
    window.value("document.querySelector('#sulcus-said .more').click()")
    assert window.wait(f"{shown} == 'block'")
    window.value("document.querySelector('#sulcus-said .more').click()")
    before = demo.wish.style
    window.press("s", "KeyS")
    assert wait_for(lambda: demo.wish.style != before)
    window.press("?", "Slash")
    assert window.wait(f"document.getElementById('{HELP}').open")
    window.value(f"document.querySelector('#{HELP} button').click()")
    assert window.wait(f"!document.getElementById('{HELP}').open")
    window.value("document.querySelector('[aria-label=\"force [N]\"][role=slider]').focus()")
    window.press("ArrowRight", "ArrowRight")
    assert wait_for(lambda: demo.wish.tool == HAND) and demo.wish.number == 40
    window.press(" ", "Space")
    assert wait_for(lambda: demo.wish.tool == HAND) and not demo.wish.plays
    assert window.errors == []
