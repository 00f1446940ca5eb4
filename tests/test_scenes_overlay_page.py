"""Page of a video or a camera: image, text, several visitors and a real browser."""

import re
import threading
import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from chromium import PROGRAM, SIZES, Chromium, assert_fits, assert_in_register, box_of
from films import FILM
from visitor import Visitor, free_port, wait_for

from ar.page.elements import HISTORY, KEYS, PICTURE, SAID, SLICES, TABS
from ar.tracking.image_sequences import read_video
from scenes.cli import main
from scenes.tracked.follower import TumourState
from scenes.tracked.overlay_painter import Painter
from scenes.tracked.page import OverlayPage
from scenes.tracked.seekable_video import SeekableVideo


@contextmanager
def opened(follower, stage, frames=0):
    page = OverlayPage(follower, Painter(stage, follower.tool), "film.mp4", "a test", port=free_port(), frames=frames)
    try:
        yield page
    finally:
        page.close()


@pytest.fixture(scope="module")
def page(follower, stage):
    """The page of the film, paused."""
    film = SeekableVideo(FILM / "film.mp4", 30.0)
    done = threading.Event()
    with opened(follower, stage, film.count) as page:
        page.plays = False
        page.browser.show_playback(False)

        def play():
            while not done.is_set():
                page.play(film, 0.3)

        loop = threading.Thread(target=play)
        loop.start()
        assert seek(page, 6)
        yield page
        done.set()
        loop.join()


def seek(page, number):
    page.requested.append(number)
    return wait_for(lambda: page.browser.shown[0] == number and f"image {number} of" in page.browser.shown[2])


@pytest.mark.parametrize(
    ("number", "state", "words"),
    [
        (6, TumourState.GOOD, "The tumour is drawn where it is now."),
        (8, TumourState.NO_TOOL, "tool not seen yet: the tumour as in the scan"),
        (12, TumourState.NO_REFERENCE, "reference not seen yet: nothing is drawn"),
    ],
)
def test_page_text_has_tracking_state_and_both_errors(page, number, state, words):
    assert seek(page, number)
    said = page.browser.shown[2]
    assert page.newest.result.state is state and words in said and "Tumour position error: not known" in said
    if state is TumourState.GOOD:
        assert re.search(r'"number">tip to tumour \d+\.\d&nbsp;±&nbsp;\d\.\d&nbsp;mm<', said)
        assert "Overlay error (95 %): at most 0.2 mm" in said and "not given:" in said
        assert "What the camera's calibration adds is not known." in said
        assert "reference seen; tool seen; tumour moved 0.5&nbsp;±&nbsp;0.1&nbsp;mm (error of model and tool)" in said
    else:
        assert "tip to tumour: not known" in said and "Overlay error: not known" in said
        sample = page.history.samples[-1]
        assert sample.values == sample.errors[:1] + (None,) == (None, None)


def test_style_change_redraws_a_paused_image(page):
    assert seek(page, 6)
    before = page.browser.shown[1]
    visitor = Visitor(page.browser, 1200)
    assert wait_for(lambda: page.browser.visitors == 1)
    visitor.set(page.browser.inputs["overlay"], "none")
    assert wait_for(lambda: page.browser.shown[1] is not before and page.browser.shown[0] == 6)
    assert not np.array_equal(page.browser.shown[1], before)
    other = Visitor(page.browser, 1200)
    assert wait_for(lambda: "Visitor 1 has control" in str(other.updates))
    other.set(page.browser.inputs["overlay"], "outline")
    time.sleep(0.3)
    assert page.style == "none"
    visitor.set(page.browser.inputs["overlay"], "outline and window")
    assert wait_for(lambda: np.array_equal(page.browser.shown[1], before))
    for each in (visitor, other):
        each.wire.close()
    assert wait_for(lambda: page.browser.visitors == 0)


def test_video_page_restarts_after_the_last_image(follower, stage):
    film = SeekableVideo(FILM / "film.mp4", 30.0)
    film.count = 40  # as a file may say
    with opened(follower, stage, film.count) as page:

        def played(start, count):
            page.requested.append(start)
            before, until = len(page.overlays), time.monotonic() + 30.0
            while len(page.overlays) < before + count and time.monotonic() < until:
                page.play(film, 1.5)  # what is known of a picture is so for one call
            return [each.result.state for each in list(page.overlays)[before : before + count]]

        assert (
            played(14, 4) == [TumourState.GOOD, TumourState.GOOD, TumourState.GOOD, TumourState.REST]
            and film.count == 17
        )
        # By now it is known how far apart its pictures are.
        assert played(14, 2) == [TumourState.GOOD, TumourState.STALE]
        one = page.overlays[0]
    assert one.image.size == one.result.motion.positions.size == 0 and one.centroid.shape == (3,)


def test_camera_image_dims_when_stale_and_recovers(follower, stage):
    first = next(read_video(FILM / "film.mp4", 30.0, with_colour=True))

    def pictures():
        yield replace(first, time=time.perf_counter())
        yield None
        fades.append(page.browser.wanted)
        time.sleep(1.1)
        yield None
        fades.append(page.browser.wanted)
        yield replace(first, time=time.perf_counter())
        fades.append(page.browser.wanted)
        page.plays = False
        yield None
        fades.append(page.browser.wanted)

    fades = []
    with opened(follower, stage) as page:
        shown = page.watch(pictures())
        assert not page.browser.frame.visible and len(page.browser.controls.commands) == len(KEYS) - 2
        assert len(shown) == 2 and {each.result.state for each in shown} <= {TumourState.REST, TumourState.STALE}
        assert all(each.latency > 0.0 for each in shown)
        silent, unplugged, back, paused = fades
        assert "no image for 0.2 s" in silent[2] and silent[1].mean() < 0.4 * first.colour.mean()
        assert re.search("no image for [1-9][0-9]* s: what is shown is old", unplugged[2])
        assert "Is film.mp4 plugged in?" in unplugged[2]
        assert back[1].mean() > 0.8 * first.colour.mean() and "live from film.mp4" in back[2]
        assert "paused: what is shown is old" in paused[2] and "Overlay error: not known" in paused[2]
        with pytest.raises(ValueError, match="calibrate it at this size"):
            page.plays = True
            page.watch(iter([replace(first, grey=first.grey[::2])]), 0.1)


def test_overlay_page_serves_video_and_demo_rejects_video(capsys):
    given = [f"--camera={FILM}/camera.yaml", f"--registration={FILM}/registration.json", "--device", "cpu"]
    film, port = str(FILM / "film.mp4"), str(free_port())
    assert main(["overlay", film, *given, "--page", "--port", port, "--seconds", "2"]) == 1  # nobody knows the motion
    said = capsys.readouterr().out
    assert f"open http://localhost:{port} (Ctrl-C ends)" in said and "its motion not known" in said
    assert main(["overlay", film, *given, "--page", "--live"]) == 2
    assert "not supported with --page" in capsys.readouterr().err
    for own in (film, "0"):
        assert main(["demo", own]) == 2
        assert f"sulcus overlay {own} --page" in capsys.readouterr().err


@pytest.fixture(scope="module")
def window(page):
    if PROGRAM is None:
        pytest.skip("there is no Chromium here")
    window = Chromium()
    window.open(page.browser.address, *SIZES[0])
    assert window.wait(f"document.querySelector('#{PICTURE} img') && document.querySelector('#{SLICES} img')")
    yield window
    window.close()


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
def test_overlay_page_fits_window_and_registers_with_image(page, window, size):
    assert seek(page, 6)
    window.size(*size)
    said = f"document.getElementById('{SAID}').innerText"
    assert window.wait(f"innerWidth == {size[0]} && {said}.includes('image\\u00a06')")
    assert_fits(window, size, ("Overlay error", "Tumour position error"))
    assert_in_register(window, page.browser.shown[1])
    for number, place in ((1, SLICES), (2, HISTORY)):
        window.value(f"document.getElementById('{TABS[number][1]}').click()")
        part = box_of(window, f"document.querySelector('#{place} > *')")
        assert part[0] >= 0 and part[2] <= size[0] and part[3] <= size[1] and part[2] - part[0] > 200.0
    window.press("ArrowRight", "ArrowRight")
    assert wait_for(lambda: page.browser.shown[0] == 7)
    assert window.errors == []
