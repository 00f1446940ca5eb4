"""The button that records what the page shows, and sends the film to who pressed it."""

from __future__ import annotations

import threading
import time as clock

import viser

from .recording import LONGEST, Recording

RECORDS, STOPS, MAKES = "Record", "Stop recording", "Making the film ..."
"""What the button says."""


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
