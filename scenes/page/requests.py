"""Requests of a page's users, and the text line that names the user who controls the tool."""

import threading
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from ar.overlay.styles import Style

from ..script.registration import Registration
from ..script.tool_paths import Touch

SCRIPT, HAND = "automatic", "manual"  # Control of the tool: scripted, manual.


class Display(NamedTuple):
    """Display settings of a solution: overlay style, camera motion and position, slice position, and registration."""

    style: Style
    path: str = ""
    through: str = ""
    tilt: float | None = None
    distance: float | None = None
    registration: Registration | None = None


@dataclass
class Requests:
    """Requests of the users, which the page's threads write and the main loop reads, under `lock`.

    `path` is the name of the camera's motion; "" means the scene's motion. `tilt` [rad] and `distance` [m] are those of
    the camera; None, as for `registration`, means the scene's value. `through` is the position of the slices. If
    `clocked`, the scene evolves without tool input; otherwise manual control pauses the script.
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
        """Set several attributes at once, under the lock."""
        with self.lock:
            for name, value in values.items():
                setattr(self, name, value)

    def set_manual_input(self, tilt_right: float | None = None, tilt_up: float | None = None, **values: float) -> None:
        """Switch to manual control with changed tool input; `tilt_right` and `tilt_up` tilt the force [rad]."""
        with self.lock:
            right, up = self.touch.tilt
            tilt = right if tilt_right is None else tilt_right, up if tilt_up is None else tilt_up
            self.touch, self.tool = replace(self.touch, tilt=tilt, **values), HAND
            self.plays = self.plays and self.clocked

    def play(self, plays: bool) -> None:
        """Play or pause. If the scene is static without tool input, playing returns the tool to the script."""
        with self.lock:
            self.plays = plays
            if plays and not self.clocked:
                self.tool = SCRIPT

    def switch_effect(self, effect: str, enabled: bool) -> None:
        """Enable or disable an effect, given by its class name."""
        with self.lock:
            self.off = self.off - {effect} if enabled else self.off | {effect}

    @property
    def display(self) -> Display:
        """Current display settings."""
        with self.lock:
            return Display(self.style, self.path, self.through, self.tilt, self.distance, self.registration)

    def read_current(self) -> tuple[int, str, Touch | None, frozenset[str]]:
        """Return frame number, deformer, manual tool input (None: scripted) and class names of disabled effects."""
        with self.lock:
            return self.number, self.deformer, self.touch if self.tool == HAND else None, self.off

    def step_playback(self, number: int, frame_count: int) -> None:
        """Advance the playback after frame `number` was shown, unless a user has requested another frame meanwhile."""
        with self.lock:
            if self.plays and self.number == number:
                self.number = (number + 1) % frame_count


def describe_tool_control(client_id: int, controlling_id: int | None, connected_ids: Collection[int]) -> str:
    """Describe for one client which client controls the tool, in Markdown.

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
