"""Recording of the page's images as a video, and the button that starts and stops it."""

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

from ..screen import write_movie

MAX_DURATION = 60.0  # Maximum duration of a recording [s]; it then ends automatically.
MAX_RECORDING_SIZE = 64_000_000  # Maximum size of a recording [characters of coded images]; it then ends automatically.
FRAME_RATE = 15.0
"""Frame rate of a recorded video [1/s]."""
RECORD_LABEL, STOP_LABEL, ENCODE_LABEL = "Record", "Stop recording", "Encoding the video ..."
"""Labels of the button in its three states: ready, recording, encoding."""


@dataclass
class PageRecording:
    """Recorded images, as data URLs of `to_data_url` with their arrival times [s]."""

    start_time: float
    images: list[tuple[float, str]] = field(default_factory=list)
    size: int = 0

    def add_image(self, data_url: str, time: float) -> None:
        """Add an image, unless it equals the last one or the recording is full."""
        if (not self.images or self.images[-1][1] is not data_url) and not self.is_full(time):
            self.images.append((time, data_url))
            self.size += len(data_url)

    def is_full(self, time: float) -> bool:
        """Return True if the recording has reached its maximum duration or size."""
        return time - self.start_time >= MAX_DURATION or self.size >= MAX_RECORDING_SIZE

    def encode_video(self, end_time: float) -> bytes:
        """Return an MP4 video of the recording until `end_time` [s], in real time; frames have the first image's size.

        Raises
        ------
        ValueError
            There are no recorded images.
        OSError
            The disk has too little space.
        """
        with tempfile.TemporaryDirectory(prefix="sulcus-") as folder:
            path = Path(folder) / "page.mp4"
            write_movie(
                path, replay_images(self.images, min(end_time, self.start_time + MAX_DURATION), FRAME_RATE), FRAME_RATE
            )
            return path.read_bytes()


def replay_images(images: Sequence[tuple[float, str]], end_time: float, rate: float) -> Iterator[np.ndarray]:
    """Yield the image (H, W, 3) uint8 that was shown at each step of a clock with `rate` [1/s], until `end_time`."""
    size: tuple[int, int] | None = None
    for number, (began, code) in enumerate(images):
        until = images[number + 1][0] if number + 1 < len(images) else max(end_time, began)
        # Steps before each end are counted, so that the video lasts as long as the recording.
        start, stop = (round((time - images[0][0]) * rate) for time in (began, until))
        if number + 1 == len(images):
            stop = max(stop, start + 1)
        if stop == start:
            continue
        colour = decode_data_url(code)
        size = size or (colour.shape[1], colour.shape[0])
        if (colour.shape[1], colour.shape[0]) != size:
            colour = cv2.resize(colour, size, interpolation=cv2.INTER_AREA)
        for _ in range(stop - start):
            yield colour


def decode_data_url(data_url: str) -> np.ndarray:
    """Decode a data URL of `to_data_url` to an image (H, W, 3) uint8."""
    written = np.frombuffer(base64.b64decode(data_url.partition(",")[2]), np.uint8)
    return cv2.cvtColor(cv2.imdecode(written, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)  # type: ignore[arg-type]


class Recorder:
    """Recorder of one video at a time, until the button is pressed, the recording is full, or its client leaves."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.server = server
        self.lock = threading.Lock()
        self.recording: PageRecording | None = None
        self.client: viser.ClientHandle | None = None
        self.button: viser.GuiButtonHandle | None = None
        self.name = "sulcus"
        self.making = False

    def add_button(self, file_name: str) -> viser.GuiButtonHandle:
        """Add the button to the page and return it; `file_name` is the video's name without suffix."""
        hint = f"record the image as a video (.mp4), at most {MAX_DURATION:.0f} seconds"
        self.button, self.name = (
            self.server.gui.add_button(RECORD_LABEL, hint=hint, icon=viser.Icon.PLAYER_RECORD, color="gray"),
            file_name,
        )
        self.update_label()
        return self.button

    def toggle_recording(self, client: viser.ClientHandle, data_url: str) -> None:
        """Start a recording with the shown image `data_url`, or end the recording and send the video."""
        with self.lock:
            if self.making:
                return
            if self.recording is None:
                self.recording, self.client = PageRecording(clock.monotonic()), client
                self.recording.add_image(data_url, clock.monotonic())
                self.update_label()
                return
        self.end_recording()

    def add_image(self, data_url: str) -> None:
        """Add a shown image; end a full recording, and discard a recording whose client has left."""
        with self.lock:
            recording, client = self.recording, self.client
            if recording is None or client is None:
                return
            if client.client_id not in self.server.get_clients():
                self.recording = self.client = None
                self.update_label()
                return
            recording.add_image(data_url, clock.monotonic())
        if recording.is_full(clock.monotonic()):
            self.end_recording()

    def end_recording(self) -> None:
        """End the recording; a separate thread encodes the video and sends it."""
        with self.lock:
            recording, client = self.recording, self.client
            self.recording = self.client = None
            if recording is None or client is None:
                return
            self.making = True
            self.update_label()
        threading.Thread(
            target=self.send_video, args=(recording, client, clock.monotonic()), name="film", daemon=True
        ).start()

    def send_video(self, recording: PageRecording, client: viser.ClientHandle, end_time: float) -> None:
        """Send the video of a recording to its client; if encoding fails, show the reason."""
        try:
            client.send_file_download(f"{self.name}.mp4", recording.encode_video(end_time), save_immediately=True)
        except (OSError, ValueError) as error:
            client.add_notification("The video could not be written.", str(error), color="red")
        finally:
            with self.lock:
                self.making = False
                self.update_label()

    def update_label(self) -> None:
        """Set the button's label to the recorder's state."""
        words = ENCODE_LABEL if self.making else RECORD_LABEL if self.recording is None else STOP_LABEL
        button = self.button
        if button is not None and button.label != words:
            button.label, button.color = words, "red" if words == STOP_LABEL else "gray"
