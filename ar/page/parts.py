"""What a page is made of: surfaces and signs in the 3-D view, a first view of it, playback, controls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np


@dataclass(frozen=True, eq=False)
class Body:
    """A surface in the 3-D view: vertices (V, 3) [m], triangles (F, 3), colour (3,) sRGB in [0, 1].

    The browser makes normals anew for each update: some 5,000 vertices for all bodies together stay fluent.
    """

    name: str
    vertices: np.ndarray
    triangles: np.ndarray
    colour: tuple[float, float, float] = (0.8, 0.8, 0.8)
    opacity: float = 1.0
    wireframe: bool = False


@dataclass(frozen=True, eq=False)
class Sign:
    """A word in the 3-D view, at a place (3,) [m]."""

    word: str
    place: np.ndarray


@dataclass(frozen=True)
class Slider:
    """A number that a visitor sets; `changed` takes it, on the page's own thread, and must return at once.

    `label` is its name for `Browser.put`; `words` are shown in the name's place, `hint` under the pointer.
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
    """A key of the keyboard: as JavaScript and as viser call it, what is shown for it, and what it does."""

    name: str
    hotkey: Literal["space", "arrowleft", "arrowright", "S", "R"]
    shown: str
    does: str


@dataclass(frozen=True)
class Choice:
    """One of several names; the rest as in `Slider`. A `key` takes the next one."""

    label: str
    options: tuple[str, ...]
    start: str
    changed: Callable[[str], None]
    words: str = ""
    hint: str | None = None
    key: Key | None = None


@dataclass(frozen=True)
class Toggle:
    """Something that is on or off; the rest as in `Slider`."""

    label: str
    start: bool
    changed: Callable[[bool], None]
    words: str = ""
    hint: str | None = None


@dataclass(frozen=True)
class Fold:
    """Controls that are out of sight until a visitor opens them."""

    label: str
    controls: tuple[Slider | Choice | Toggle, ...]


@dataclass(frozen=True)
class Note:
    """Words, HTML, that a visitor opens to read them, for `Browser.write`; there is no note while there are none."""

    label: str
    words: str = ""


Control = Slider | Choice | Toggle


@dataclass(frozen=True)
class Playback:
    """Play, pause and scrub over frames 0 .. frames - 1: `played` takes whether to play, `sought` a frame number.

    Of 0 frames, as of a camera, there is nothing to scrub over.
    """

    frames: int
    played: Callable[[bool], None]
    sought: Callable[[int], None]


@dataclass(frozen=True)
class Deed:
    """What a visitor set last: the visitor's number, from 1, and the label of the control."""

    visitor: int
    label: str


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Where the 3-D view starts: eye, target and up direction, (3,) [m]; vertical field of view [rad]."""

    eye: np.ndarray
    target: np.ndarray
    up: np.ndarray
    fov: float = np.radians(50.0)
