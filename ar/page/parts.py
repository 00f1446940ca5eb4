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
class ScenePicture:
    """Image (H, W, 4) uint8 in the 3-D view: centre (3,), edges to its right and downwards (3,) [m]."""

    name: str
    colour: np.ndarray
    centre: np.ndarray
    right: np.ndarray
    down: np.ndarray


@dataclass(frozen=True, eq=False)
class Sign:
    """Text label in the 3-D view, at a position (3,) [m]."""

    word: str
    place: np.ndarray


@dataclass(frozen=True)
class Slider:
    """Slider for a number; `changed` receives the number, on the page's own thread, and must return at once.

    `label` is its name for `Browser.put`; `words` are shown instead of the name, `hint` as a tooltip.
    """

    label: str
    low: float
    high: float
    step: float
    start: float
    changed: Callable[[float], None]
    words: str = ""
    hint: str | None = None


@dataclass(frozen=True)
class Key:
    """Key of the keyboard: its names in JavaScript and in viser, its shown symbol, and its action."""

    name: str
    hotkey: Literal["space", "arrowleft", "arrowright", "S", "R"]
    shown: str
    does: str


@dataclass(frozen=True)
class Dropdown:
    """Selection of one of several names; other fields as in `Slider`. A `key` selects the next one."""

    label: str
    options: tuple[str, ...]
    start: str
    changed: Callable[[str], None]
    words: str = ""
    hint: str | None = None
    key: Key | None = None


@dataclass(frozen=True)
class Toggle:
    """Checkbox; other fields as in `Slider`."""

    label: str
    start: bool
    changed: Callable[[bool], None]
    words: str = ""
    hint: str | None = None


@dataclass(frozen=True)
class Fold:
    """Folder of controls and notes, closed at first unless it is `opened`."""

    label: str
    controls: tuple[Slider | Dropdown | Toggle | Note, ...]
    opened: bool = False


@dataclass(frozen=True)
class Note:
    """Folder of words (HTML) that a user can open, for `Browser.write`; hidden while empty. `plain`: without folder."""

    label: str
    words: str = ""
    plain: bool = False


Control = Slider | Dropdown | Toggle


@dataclass(frozen=True)
class Playback:
    """Play, pause and seek over frames 0 .. frames - 1: `played` receives whether to play, `sought` a frame number.

    With 0 frames, as for a camera, there is no seeking.
    """

    frames: int
    played: Callable[[bool], None]
    sought: Callable[[int], None]


@dataclass(frozen=True)
class LastChange:
    """Last action of a client: its number, from 1, and the label of the control."""

    visitor: int
    label: str


@dataclass(frozen=True, eq=False)
class SceneViewpoint:
    """Initial viewpoint of the 3-D view: eye, target and up direction, (3,) [m]; vertical field of view [rad]."""

    eye: np.ndarray
    target: np.ndarray
    up: np.ndarray
    fov: float = np.radians(50.0)
