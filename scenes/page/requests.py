"""Requests of a page's users, and the line that describes who controls the tool."""

import threading
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from ar.overlay.styles import Style

from ..script.registration import Registration
from ..script.tool_paths import Touch

SCRIPT, HAND = "automatic", "manual"  # Control of the tool: scripted, manual.


class Display(NamedTuple):
    """Display of a solution: overlay style, path and position of the camera, position of the slices, registration."""

    style: Style
    path: str = ""
    through: str = ""
    tilt: float | None = None
    distance: float | None = None
    registration: Registration | None = None


@dataclass
class Requests:
    """Requests of the users, written by the page's threads and read by the loop, under its lock.

    `path` is the name of the camera's motion; "": the scene's own. `tilt` [rad] and `distance` [m] move the camera;
    None: as the scene has it, as for `registration`. `through` is the position of the slices. `clocked` is true if
    the scene evolves without tool input: otherwise manual control pauses the script.
    """

    deformer: str
    touch: Touch
    scene: str = ""
    tool: str = SCRIPT
    holder: int | None = None
    plays: bool = True
    number: int = 0
    off: frozenset[str] = frozenset()
    style: Style = "window"
    path: str = ""
    through: str = ""
    tilt: float | None = None
    distance: float | None = None
    registration: Registration | None = None
    clocked: bool = False
    lock: threading.Lock = field(default_factory=threading.Lock)

    def set(self, **values: object) -> None:
        """Change several requests at once."""
        with self.lock:
            for name, value in values.items():
                setattr(self, name, value)

    def take_over(self, right: float | None = None, up: float | None = None, **values: float) -> None:
        """Switch to manual control with some values of the touch changed; `right` and `up` tilt the force [rad]."""
        with self.lock:
            tilt = self.touch.tilt[0] if right is None else right, self.touch.tilt[1] if up is None else up
            self.touch, self.tool = replace(self.touch, tilt=tilt, **values), HAND
            self.plays = self.plays and self.clocked

    def play(self, plays: bool) -> None:
        """Play or pause; in a scene that is static without tool input, playing returns the tool to the script."""
        with self.lock:
            self.plays = plays
            if plays and not self.clocked:
                self.tool = SCRIPT

    def switch_effect(self, effect: str, enabled: bool) -> None:
        """Switch an effect on or off."""
        with self.lock:
            self.off = self.off - {effect} if enabled else self.off | {effect}

    @property
    def look(self) -> Display:
        """Display style of a solution."""
        with self.lock:
            return Display(self.style, self.path, self.through, self.tilt, self.distance, self.registration)

    def read_current(self) -> tuple[int, str, Touch | None, frozenset[str]]:
        """Return frame number, deformer, manual touch (None: the script's) and disabled effects."""
        with self.lock:
            return self.number, self.deformer, self.touch if self.tool == HAND else None, self.off

    def step_playback(self, number: int, frame_count: int) -> None:
        """Advance playback after a frame was shown, unless a user has requested another one meanwhile."""
        with self.lock:
            if self.plays and self.number == number:
                self.number = (number + 1) % frame_count


def describe_tool_control(client_id: int, controlling_id: int | None, connected_ids: Collection[int]) -> str:
    """Describe who controls the tool, for one client.

    Parameters
    ----------
    client_id
        Number of the client that reads the text.
    controlling_id
        Number of the client that took the tool last; None if the script moves the tool.
    connected_ids
        Numbers of the connected clients.
    """
    if controlling_id is None:
        text = "Automatic playback"
    elif controlling_id == client_id:
        text = "**You control the tool**"
    elif controlling_id in connected_ids:
        text = f"Visitor {controlling_id} controls the tool"
    else:
        text = f"Visitor {controlling_id}, who controlled the tool, has left: it stays in place"
    count = len(connected_ids)
    return text if count < 2 else f"{text}; {count} visitors, you are number {client_id}"
