"""Recording: what the page showed for some seconds, made into a video, and the button that records it."""

from __future__ import annotations

import base64
import tempfile
import threading
import time as clock
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import viser

from ..screen import write_film

LONGEST, LARGEST = 60.0, 64_000_000
"""A recording ends by itself after so long [s], or so many characters of coded pictures."""
RATE = 15.0
"""Pictures per second of a film."""
RECORDS, STOPS, MAKES = "Record", "Stop recording", "Making the film ..."
"""What the button says."""


@dataclass
class Recording:
    """Pictures as `coded` writes them, each with the time [s] when it came."""

    began: float
    taken: list[tuple[float, str]] = field(default_factory=list)
    size: int = 0

    def take(self, code: str, now: float) -> None:
        """Keep a picture, unless it is the last one still, or the recording is full."""
        if (not self.taken or self.taken[-1][1] is not code) and not self.full(now):
            self.taken.append((now, code))
            self.size += len(code)

    def full(self, now: float) -> bool:
        """Whether no more is kept."""
        return now - self.began >= LONGEST or self.size >= LARGEST

    def film(self, ended: float) -> bytes:
        """An MP4 of what was shown until then, as long as that took; the pictures have the size of the first.

        Raises
        ------
        ValueError
            Nothing was shown.
        OSError
            There is no room for it on the disk.
        """
        with tempfile.TemporaryDirectory(prefix="sulcus-") as folder:
            path = Path(folder) / "page.mp4"
            write_film(path, played(self.taken, min(ended, self.began + LONGEST), RATE), RATE)
            return path.read_bytes()


def played(taken: Sequence[tuple[float, str]], ended: float, rate: float) -> Iterator[np.ndarray]:
    """The picture (H, W, 3) uint8 that was shown at each step of a clock of so many steps a second."""
    size: tuple[int, int] | None = None
    for number, (began, code) in enumerate(taken):
        until = taken[number + 1][0] if number + 1 < len(taken) else max(ended, began)
        # So many steps lie before each end: the film is as long as what it shows.
        start, stop = (round((time - taken[0][0]) * rate) for time in (began, until))
        if number + 1 == len(taken):
            stop = max(stop, start + 1)
        if stop == start:
            continue
        colour = decoded(code)
        size = size or (colour.shape[1], colour.shape[0])
        if (colour.shape[1], colour.shape[0]) != size:
            colour = cv2.resize(colour, size, interpolation=cv2.INTER_AREA)
        for _ in range(stop - start):
            yield colour


def decoded(code: str) -> np.ndarray:
    """The picture (H, W, 3) uint8 of an address that `coded` wrote."""
    written = np.frombuffer(base64.b64decode(code.partition(",")[2]), np.uint8)
    return cv2.cvtColor(cv2.imdecode(written, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)  # type: ignore[arg-type]


class Recorder:
    """One recording at a time. It ends when the button is pressed again, when it is full, or with who began it."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.server = server
        self.lock = threading.Lock()
        self.recording: Recording | None = None
        self.client: viser.ClientHandle | None = None
        self.button: viser.GuiButtonHandle | None = None
        self.name = "sulcus"
        self.making = False

    def add_button(self, name: str) -> viser.GuiButtonHandle:
        """Put the button on the page; `name` is that of the file, without its suffix."""
        hint = f"what the page shows, as a film (.mp4), {LONGEST:.0f} seconds at most"
        self.button, self.name = (
            self.server.gui.add_button(RECORDS, hint=hint, icon=viser.Icon.PLAYER_RECORD, color="gray"),
            name,
        )
        self.say()
        return self.button

    def toggle(self, client: viser.ClientHandle, code: str) -> None:
        """Begin with a `coded` picture that is shown, or end and send the film."""
        with self.lock:
            if self.making:
                return
            if self.recording is None:
                self.recording, self.client = Recording(clock.monotonic()), client
                self.recording.take(code, clock.monotonic())
                self.say()
                return
        self.end()

    def take(self, code: str) -> None:
        """Keep a `coded` picture that is shown, and end where no more is kept; forget all where its owner has left."""
        with self.lock:
            recording, client = self.recording, self.client
            if recording is None or client is None:
                return
            if client.client_id not in self.server.get_clients():
                self.recording = self.client = None
                self.say()
                return
            recording.take(code, clock.monotonic())
        if recording.full(clock.monotonic()):
            self.end()

    def end(self) -> None:
        """Make the film, on a thread of its own, and send it."""
        with self.lock:
            recording, client = self.recording, self.client
            self.recording = self.client = None
            if recording is None or client is None:
                return
            self.making = True
            self.say()
        threading.Thread(
            target=self.send, args=(recording, client, clock.monotonic()), name="film", daemon=True
        ).start()

    def send(self, recording: Recording, client: viser.ClientHandle, ended: float) -> None:
        """Send the film of what was shown until then; where it cannot be made, say why."""
        try:
            client.send_file_download(f"{self.name}.mp4", recording.film(ended), save_immediately=True)
        except (OSError, ValueError) as error:
            client.add_notification("The film could not be made.", str(error), color="red")
        finally:
            with self.lock:
                self.making = False
                self.say()

    def say(self) -> None:
        """Let the button say what it does next."""
        words = MAKES if self.making else RECORDS if self.recording is None else STOPS
        button = self.button
        if button is not None and button.label != words:
            button.label, button.color = words, "red" if words == STOPS else "gray"
