"""Parts of a page: surfaces and labels in the 3-D view, its first view, playback, controls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np


@dataclass(frozen=True, eq=False)
class SceneSurface:
    """Surface in the 3-D view: vertices (V, 3) [m], triangles (F, 3), colour (3,) sRGB in [0, 1].

    The legend has the colour with the `meaning`, if there is one.
    The browser computes normals again for each update: some 5,000 vertices for all bodies together stay fluent.
    """

    name: str
    vertices: np.ndarray
    triangles: np.ndarray
    colour: tuple[float, float, float] = (0.8, 0.8, 0.8)
    opacity: float = 1.0
    wireframe: bool = False
    side: Literal["front", "back", "double"] = "double"
    meaning: str = ""


@dataclass(frozen=True, eq=False)
class SceneImage:
    """Image (H, W, 4) uint8 in the 3-D view: centre (3,), edges to its right and downwards (3,) [m]."""

    name: str
    image: np.ndarray
    centre: np.ndarray
    right: np.ndarray
    down: np.ndarray


@dataclass(frozen=True, eq=False)
class SceneLabel:
    """Text label in the 3-D view, at a position (3,) [m]."""

    text: str
    position: np.ndarray


@dataclass(frozen=True)
class Slider:
    """Slider for a number; `on_change` receives the number, on the page's own thread, and must return at once.

    `label` is its name for `Browser.put`; `text` are shown instead of the name, `hint` as a tooltip.
    """

    label: str
    lower: float
    upper: float
    step: float
    initial: float
    on_change: Callable[[float], None]
    text: str = ""
    hint: str | None = None


@dataclass(frozen=True)
class Key:
    """Key of the keyboard: its names in JavaScript and in viser, its shown symbol, and its action."""

    name: str
    hotkey: Literal["space", "arrowleft", "arrowright", "S", "R"]
    symbol: str
    action: str


@dataclass(frozen=True)
class Dropdown:
    """Selection of one of several names; other fields as in `Slider`. A `key` selects the next one."""

    label: str
    options: tuple[str, ...]
    initial: str
    on_change: Callable[[str], None]
    text: str = ""
    hint: str | None = None
    key: Key | None = None


@dataclass(frozen=True)
class Toggle:
    """Checkbox; other fields as in `Slider`."""

    label: str
    initial: bool
    on_change: Callable[[bool], None]
    text: str = ""
    hint: str | None = None


@dataclass(frozen=True)
class Folder:
    """Folder of controls and notes, closed at first unless it is `is_open`."""

    label: str
    controls: tuple[Slider | Dropdown | Toggle | Note, ...]
    is_open: bool = False


@dataclass(frozen=True)
class Note:
    """Folder of words (HTML) that a user can open, for `Browser.write`; hidden while empty. `is_plain`: no folder."""

    label: str
    text: str = ""
    is_plain: bool = False


Control = Slider | Dropdown | Toggle


@dataclass(frozen=True)
class Playback:
    """Play, pause and seek over frames 0 .. frames - 1: `on_play` receives whether to play, `on_seek` a frame number.

    With 0 frames, as for a camera, there is no seeking.
    """

    frame_count: int
    on_play: Callable[[bool], None]
    on_seek: Callable[[int], None]


@dataclass(frozen=True)
class LastChange:
    """Last action of a client: its number, from 1, and the label of the control."""

    client: int
    label: str


@dataclass(frozen=True, eq=False)
class SceneViewpoint:
    """Initial viewpoint of the 3-D view: eye, target and up direction, (3,) [m]; vertical field of view [rad]."""

    eye: np.ndarray
    target: np.ndarray
    up: np.ndarray
    fov: float = np.radians(50.0)
