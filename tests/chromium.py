"""A headless Chromium that a test drives over its DevTools protocol, with nothing but a web socket."""

import base64
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from websockets.sync.client import connect

from ar.page.elements import PICTURE, SAID
from ar.page.style import PAGE

PROGRAM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
"""Where the browser is; None where there is none."""
SIZES = [(1600, 900), (1280, 720), (900, 900), (420, 900)]
"""Windows in which a page is looked at."""
BOX = "(r => [r.left, r.top, r.right, r.bottom])({}.getBoundingClientRect())"


class Chromium:
    """One browser with one page at a time; `errors` are what the page's console said and threw since it was opened."""

    def __init__(self) -> None:
        assert PROGRAM is not None
        self.folder = tempfile.TemporaryDirectory(prefix="chromium-")
        self.process = subprocess.Popen(
            [
                PROGRAM, "--headless=new", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader", "--no-first-run", "--disable-background-networking",
                "--disable-dev-shm-usage", "--hide-scrollbars", "--remote-debugging-port=0",
                f"--user-data-dir={self.folder.name}", "about:blank",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip
        port = self._port()
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            page = next(each for each in json.load(answer) if each["type"] == "page")
        self.wire = connect(page["webSocketDebuggerUrl"], max_size=None)
        self.said, self.errors = 0, []
        for domain in ("Page", "Runtime", "Log"):
            self.ask(f"{domain}.enable")

    def _port(self) -> int:
        noted, until = Path(self.folder.name) / "DevToolsActivePort", time.monotonic() + 30.0
        while time.monotonic() < until:
            with suppress(OSError, ValueError, IndexError):
                return int(noted.read_text().splitlines()[0])
            time.sleep(0.05)
        raise TimeoutError("the browser did not start")

    def ask(self, method: str, **parameters: object) -> dict:
        """Have the browser do something, and wait for its answer."""
        self.said += 1
        self.wire.send(json.dumps({"id": self.said, "method": method, "params": parameters}))
        while True:
            heard = json.loads(self.wire.recv(30.0))
            self.note(heard)
            if heard.get("id") == self.said:
                assert "error" not in heard, heard
                return heard["result"]

    def note(self, heard: dict) -> None:
        """Keep what the page complains of."""
        said = heard.get("params", {})
        match heard.get("method"):
            case "Runtime.exceptionThrown":
                self.errors.append(said["exceptionDetails"]["text"])
            case "Runtime.consoleAPICalled" if said["type"] == "error":
                self.errors.append(" ".join(str(each.get("value", each)) for each in said["args"]))
            case "Log.entryAdded" if said["entry"]["level"] == "error":
                self.errors.append(f"{said['entry']['text']} ({said['entry'].get('url', '')})")

    def size(self, width: int, height: int) -> None:
        """Give the window another size [CSS pixel]."""
        self.ask("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def open(self, address: str, width: int, height: int) -> None:
        """Go to an address in a window of so many CSS pixels."""
        self.errors.clear()
        self.size(width, height)
        self.ask("Page.navigate", url=address)

    def value(self, script: str) -> object:
        """What a JavaScript expression comes to; a promise is waited for."""
        found = self.ask("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def wait(self, script: str, seconds: float = 20.0) -> bool:
        """Wait until a JavaScript expression holds; whether it does."""
        until = time.monotonic() + seconds
        while not (holds := bool(self.value(f"!!({script})"))) and time.monotonic() < until:
            time.sleep(0.05)
        return holds

    def press(self, key: str, code: str) -> None:
        """Press and release a key, by its name and its place as JavaScript has them."""
        text = {"text": key} if len(key) == 1 else {}
        self.ask("Input.dispatchKeyEvent", type="keyDown", key=key, code=code, **text)
        self.ask("Input.dispatchKeyEvent", type="keyUp", key=key, code=code)

    def click(self, column: float, row: float) -> None:
        """Click at a place [CSS pixel]."""
        for what in ("mousePressed", "mouseReleased"):
            self.ask("Input.dispatchMouseEvent", type=what, x=column, y=row, button="left", clickCount=1)

    def shot(self) -> bytes:
        """A picture of the window as PNG."""
        return base64.b64decode(self.ask("Page.captureScreenshot", format="png")["data"])

    def close(self) -> None:
        """End the browser."""
        self.wire.close()
        self.process.terminate()
        self.process.wait()
        with suppress(OSError):
            self.folder.cleanup()


def box_of(window: Chromium, element: str) -> np.ndarray:
    """Left, top, right and bottom of an element, once it has a size and stays where it is: layout takes a while."""
    assert window.wait(element)
    box, last, until = np.array(window.value(BOX.format(element))), None, time.monotonic() + 20.0
    while not np.array_equal(box, last) or not (box[2:] > box[:2]).all():
        assert time.monotonic() < until, f"{element} does not come to rest: {box}"
        time.sleep(0.1)
        box, last = np.array(window.value(BOX.format(element))), box
    return box


def assert_fits(window: Chromium, size: tuple[int, int], lines: tuple[str, ...]) -> None:
    """Nothing is cut off: the page, its picture, its words, and of them those that hold some lines are in sight."""
    whole, said = "document.documentElement", f"document.getElementById('{SAID}')"
    assert max(window.value(f"[{whole}.scrollWidth - innerWidth, {whole}.scrollHeight - innerHeight]")) <= 0
    left, top, right, bottom = box_of(window, f"document.querySelector('#{PICTURE} img')")
    assert left >= 0 and top >= 0 and right <= size[0] and bottom <= size[1]
    for name in (PAGE, SAID):
        words = f"document.getElementById('{name}')"
        assert window.wait(f"{words}.scrollHeight <= {words}.clientHeight"), name
    shut = "[...document.querySelectorAll('input:not([type=radio])')].filter(i => i.scrollWidth > i.clientWidth)"
    assert not window.value(f"{shut}.map(i => i.value)")
    room = box_of(window, said)
    for words in lines:
        line = box_of(window, f"[...document.querySelectorAll('#{SAID} p')].find(p => p.innerText.includes('{words}'))")
        assert line[1] >= room[1] and line[3] <= min(room[3], size[1]) and line[2] <= size[0], words


def assert_in_register(window: Chromium, colour: np.ndarray) -> None:
    """The picture on the page is the server's (H, W, 3), to a pixel."""
    left, top, right, bottom = box_of(window, f"document.querySelector('#{PICTURE} img')")
    shown = cv2.imdecode(np.frombuffer(window.shot(), np.uint8), cv2.IMREAD_GRAYSCALE).astype(np.float64)
    seen = shown[round(top) : round(bottom), round(left) : round(right)]
    sent = cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY).astype(np.float64)
    smaller = seen.size < sent.size
    sent = cv2.resize(sent, seen.shape[::-1], interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
    shift, _ = cv2.phaseCorrelate(sent, seen, cv2.createHanningWindow(seen.shape[::-1], cv2.CV_64F))
    assert max(map(abs, shift)) < 1.0
    assert np.corrcoef(sent.ravel(), seen.ravel())[0, 1] > 0.98
