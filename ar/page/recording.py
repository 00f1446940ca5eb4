"""Recording of the page's recent images as a video, and the button that records it."""

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

MAX_DURATION = 60.0  # Maximum duration of a recording [s]; it then ends automatically.
MAX_RECORDING_SIZE = 64_000_000  # Maximum size of a recording [characters of coded images]; it then ends automatically.
FRAME_RATE = 15.0
"""Frame rate of a video [1/s]."""
RECORD_LABEL, STOP_LABEL, ENCODE_LABEL = "Record", "Stop recording", "Encoding the video ..."
"""Labels of the button: start, stop, encoding in progress."""


@dataclass
class PageRecording:
    """Images encoded by `to_data_url`, each with its arrival time [s]."""

    began: float
    taken: list[tuple[float, str]] = field(default_factory=list)
    size: int = 0

    def take(self, code: str, now: float) -> None:
        """Keep an image, unless it equals the last one, or the recording is full."""
        if (not self.taken or self.taken[-1][1] is not code) and not self.is_full(now):
            self.taken.append((now, code))
            self.size += len(code)

    def is_full(self, now: float) -> bool:
        """Return True if the recording is full."""
        return now - self.began >= MAX_DURATION or self.size >= MAX_RECORDING_SIZE

    def encode_video(self, ended: float) -> bytes:
        """Return an MP4 video of the recording up to `ended` [s], in real time; all frames have the size of the first.

        Raises
        ------
        ValueError
            No recorded images.
        OSError
            Not enough space on the disk.
        """
        with tempfile.TemporaryDirectory(prefix="sulcus-") as folder:
            path = Path(folder) / "page.mp4"
            write_film(path, replay_images(self.taken, min(ended, self.began + MAX_DURATION), FRAME_RATE), FRAME_RATE)
            return path.read_bytes()


def replay_images(taken: Sequence[tuple[float, str]], ended: float, rate: float) -> Iterator[np.ndarray]:
    """Yield the image (H, W, 3) uint8 shown at each step of a clock with `rate` steps a second."""
    size: tuple[int, int] | None = None
    for number, (began, code) in enumerate(taken):
        until = taken[number + 1][0] if number + 1 < len(taken) else max(ended, began)
        # Steps before each end are counted, so that the video lasts as long as the recording.
        start, stop = (round((time - taken[0][0]) * rate) for time in (began, until))
        if number + 1 == len(taken):
            stop = max(stop, start + 1)
        if stop == start:
            continue
        colour = decode_recorded(code)
        size = size or (colour.shape[1], colour.shape[0])
        if (colour.shape[1], colour.shape[0]) != size:
            colour = cv2.resize(colour, size, interpolation=cv2.INTER_AREA)
        for _ in range(stop - start):
            yield colour


def decode_recorded(code: str) -> np.ndarray:
    """Decode an image (H, W, 3) uint8 from a data URL of `to_data_url`."""
    written = np.frombuffer(base64.b64decode(code.partition(",")[2]), np.uint8)
    return cv2.cvtColor(cv2.imdecode(written, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)  # type: ignore[arg-type]


class Recorder:
    """Recorder of one video at a time. It ends when stopped by the button, when full, or when its client leaves."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.server = server
        self.lock = threading.Lock()
        self.recording: PageRecording | None = None
        self.client: viser.ClientHandle | None = None
        self.button: viser.GuiButtonHandle | None = None
        self.name = "sulcus"
        self.making = False

    def add_button(self, name: str) -> viser.GuiButtonHandle:
        """Add the button to the page; `name` is the file name without suffix."""
        hint = f"record the image as a video (.mp4), at most {MAX_DURATION:.0f} seconds"
        self.button, self.name = (
            self.server.gui.add_button(RECORD_LABEL, hint=hint, icon=viser.Icon.PLAYER_RECORD, color="gray"),
            name,
        )
        self.update_label()
        return self.button

    def toggle(self, client: viser.ClientHandle, code: str) -> None:
        """Start with a shown `coded` image, or end and send the video."""
        with self.lock:
            if self.making:
                return
            if self.recording is None:
                self.recording, self.client = PageRecording(clock.monotonic()), client
                self.recording.take(code, clock.monotonic())
                self.update_label()
                return
        self.end()

    def take(self, code: str) -> None:
        """Keep a shown `coded` image, and end the recording once full; discard it if its client has left."""
        with self.lock:
            recording, client = self.recording, self.client
            if recording is None or client is None:
                return
            if client.client_id not in self.server.get_clients():
                self.recording = self.client = None
                self.update_label()
                return
            recording.take(code, clock.monotonic())
        if recording.is_full(clock.monotonic()):
            self.end()

    def end(self) -> None:
        """Encode the video on a thread of its own, and send it."""
        with self.lock:
            recording, client = self.recording, self.client
            self.recording = self.client = None
            if recording is None or client is None:
                return
            self.making = True
            self.update_label()
        threading.Thread(
            target=self.send, args=(recording, client, clock.monotonic()), name="film", daemon=True
        ).start()

    def send(self, recording: PageRecording, client: viser.ClientHandle, ended: float) -> None:
        """Send the video of the recording; if that fails, report the reason."""
        try:
            client.send_file_download(f"{self.name}.mp4", recording.encode_video(ended), save_immediately=True)
        except (OSError, ValueError) as error:
            client.add_notification("The video could not be written.", str(error), color="red")
        finally:
            with self.lock:
                self.making = False
                self.update_label()

    def update_label(self) -> None:
        """Set the button's label to its next action."""
        words = ENCODE_LABEL if self.making else RECORD_LABEL if self.recording is None else STOP_LABEL
        button = self.button
        if button is not None and button.label != words:
            button.label, button.color = words, "red" if words == STOP_LABEL else "gray"
