"""Parts of a page: surfaces and labels of the 3-D view, initial viewpoint, playback, and controls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np


@dataclass(frozen=True, eq=False)
class SceneSurface:
    """Surface in the 3-D view: vertices (V, 3) [m], triangles (F, 3), colour (3,) sRGB in [0, 1].

    If `meaning` is not empty, the legend shows it with the colour. The browser recomputes normals for each update, so
    all surfaces together should have at most some 5,000 vertices.
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
    """Image (H, W, 4) uint8 in the 3-D view, with its centre (3,) and the edges to its right and bottom (3,) [m]."""

    name: str
    image: np.ndarray
    centre: np.ndarray
    right: np.ndarray
    down: np.ndarray


@dataclass(frozen=True, eq=False)
class SceneLabel:
    """Text label in the 3-D view at `position` (3,) [m]."""

    text: str
    position: np.ndarray


@dataclass(frozen=True)
class Slider:
    """Slider for a number; `on_change` receives the number in the page's thread, and must return immediately.

    `label` is the control's name for `Browser.put`; `text` is shown instead if not empty, `hint` as a tooltip.
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
    """Key of the keyboard: its names in JavaScript and viser, the symbol shown for it, and its action."""

    name: str
    hotkey: Literal["space", "arrowleft", "arrowright", "S", "R"]
    symbol: str
    action: str


@dataclass(frozen=True)
class Dropdown:
    """Selection of one of several names; the optional `key` selects the next name. Other fields as in `Slider`."""

    label: str
    options: tuple[str, ...]
    initial: str
    on_change: Callable[[str], None]
    text: str = ""
    hint: str | None = None
    key: Key | None = None


@dataclass(frozen=True)
class Toggle:
    """Checkbox; `on_change` receives its state. Other fields as in `Slider`."""

    label: str
    initial: bool
    on_change: Callable[[bool], None]
    text: str = ""
    hint: str | None = None


@dataclass(frozen=True)
class Folder:
    """Folder of controls and notes; it is closed initially unless `is_open`."""

    label: str
    controls: tuple[Slider | Dropdown | Toggle | Note, ...]
    is_open: bool = False


@dataclass(frozen=True)
class Note:
    """Folder with text (HTML), see `Browser.write`; hidden while empty. If `is_plain`, the text has no folder."""

    label: str
    text: str = ""
    is_plain: bool = False


Control = Slider | Dropdown | Toggle


@dataclass(frozen=True)
class Playback:
    """Playback over frames 0 .. frame_count - 1: `on_play` receives True to play, `on_seek` a frame number.

    If `frame_count` is 0, as for a camera, there is no seeking.
    """

    frame_count: int
    on_play: Callable[[bool], None]
    on_seek: Callable[[int], None]


@dataclass(frozen=True)
class LastChange:
    """Last action of a client: number of the client, from 1, and label of the control."""

    client: int
    label: str


@dataclass(frozen=True, eq=False)
class SceneViewpoint:
    """Initial viewpoint of the 3-D view: eye, target and upward direction, (3,) [m]; vertical field of view [rad]."""

    eye: np.ndarray
    target: np.ndarray
    up: np.ndarray
    fov: float = np.radians(50.0)
