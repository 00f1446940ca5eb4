"""The loop: a scripted tool, a deformer and a camera make one frame after the other."""

from __future__ import annotations

import time as clock
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import trimesh

from ar.camera import Camera
from ar.hud import panel
from ar.layer import Layer
from ar.overlay import Gauge, Style, composite
from ar.view import Picture, render
from sim.deformation import Deformation, Deformer
from sim.effects import remember
from sim.loads import Loads
from surrogate.learned import Learned

from .paths import AIR, Touch
from .scene import Scene
from .site import Site
from .stage import TOOL, Stage
from .told import told
from .tool import Blade, Probe

STAGES = ("deform", "render", "overlay")
"""What the time of a frame is spent on."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One moment of a scene.

    Parameters
    ----------
    number, time
        From 0; [s].
    touch, loads
        What the hand asked for, and what that does to the tissue.
    deformation
        The deformer's answer.
    camera
        The camera that the picture was drawn with.
    pose, tip
        T_world_tool (4, 4), and where the tool touches (3,) [m]; None where the scene has no tool.
    picture
        What the camera sees, without overlay.
    shown
        The picture with the predicted tumour in it (H, W, 3) uint8.
    distance
        From the tool's tip to the tumour's predicted surface [m]; None without a tool.
    moved
        Mean distance of the tumour's predicted surface from where the scan has it [m].
    seconds
        Wall time by stage, see `STAGES`.
    """

    number: int
    time: float
    touch: Touch
    loads: Loads
    deformation: Deformation
    camera: Camera
    pose: np.ndarray | None
    tip: np.ndarray | None
    picture: Picture
    shown: np.ndarray
    distance: float | None
    moved: float
    seconds: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Player:
    """A scene on a stage with one deformer. `draw` is a pure function of time, touch and the previous answer."""

    stage: Stage
    deformer: Deformer
    style: Style = "window"

    @property
    def scene(self) -> Scene:
        """The scene that is played."""
        return self.stage.scene

    @property
    def site(self) -> Site:
        """The open cortex that it is played on."""
        return self.stage.site

    @cached_property
    def camera(self) -> Camera:
        """The scene's camera."""
        return self.scene.viewpoint.camera(self.site)

    @cached_property
    def remembers(self) -> bool:
        """Whether an answer depends on the one before it."""
        return not isinstance(self.deformer, Learned) and remember(self.scene.effects_on(self.site.anatomy))

    def touch(self, number: int) -> Touch:
        """What the script's hand asks for in a frame."""
        return self.scene.path(float(self.scene.times[number]))

    def loads(self, number: int, touch: Touch | None = None) -> Loads:
        """What acts in a frame; `touch` in place of the script's."""
        return self.scene.loads(self.site, touch or self.touch(number), float(self.scene.times[number]))

    def answer(self, loads: Loads, last: Deformation | None = None) -> Deformation:
        """The deformer's answer, from the last one: a learnt model's at the drawn vertices, which are all it knows."""
        if isinstance(self.deformer, Learned):
            return self.deformer.deform(loads, at=self.stage.nodes)
        return self.deformer.deform(loads, start=last)

    def draw(self, number: int, time: float, touch: Touch, last: Deformation | None = None) -> Frame:
        """The frame of a touch at a time [s]; the deformer starts from the last answer."""
        begun = clock.perf_counter()
        loads = self.scene.loads(self.site, touch, time)
        deformation = self.answer(loads, last)
        return self.drawn(number, touch, loads, deformation, clock.perf_counter() - begun)

    def drawn(self, number: int, touch: Touch, loads: Loads, deformation: Deformation, seconds: float) -> Frame:
        """The frame of an answer to loads, which took so many seconds."""
        begun = clock.perf_counter()
        margin = self._margin(self.deformer, deformation) if isinstance(self.deformer, Learned) else 0.0
        positions = self.positions(deformation)
        tip, pose = (None, None) if self.scene.tool is None else self.tool(self.scene.tool, touch, positions)
        stage = self.stage.at(loads)
        picture = render(self.camera, stage.layers(positions, pose), stage.lamp)
        rendered = clock.perf_counter()
        tumour, rest = (stage.tumour(at) for at in (positions, self.site.anatomy.mesh.nodes))
        gauge = None if tip is None else gauged(tip, tumour)
        over = composite(picture, self.camera, tumour, (TOOL,), self.style, margin=margin, gauge=gauge)
        spent = seconds, rendered - begun, clock.perf_counter() - rendered
        return Frame(
            number, float(loads.times[0]), touch, loads, deformation, self.camera, pose, tip, picture, over.colour,
            None if gauge is None else gauge.distance,
            float(np.linalg.norm(tumour.vertices - rest.vertices, axis=1).mean()),
            dict(zip(STAGES, spent, strict=True)),
        )  # fmt: skip

    def _margin(self, model: Learned, answer: Deformation) -> float | np.ndarray:
        """How far each vertex of the drawn tumour may be off [m]: what the model promises of this load, if it does."""
        if model.bounds is None:
            return model.bound
        return model.margin(answer)[0][np.searchsorted(model.anatomy.tumour_nodes, self.stage.tumour_vertices)]

    def frames(self, every: int = 1) -> Iterator[Frame]:
        """The frames of the scene, or every so many of them."""
        last = None
        for number in range(0, len(self.scene.times), every):
            time = float(self.scene.times[number])
            frame = self.draw(number, time, self.scene.path(time), last)
            last = frame.deformation
            yield frame

    def positions(self, deformation: Deformation, row: int = 0) -> np.ndarray:
        """Where all mesh vertices are (V, 3) [m] in one load case; what the deformer does not know is at rest."""
        positions = self.site.anatomy.mesh.nodes.copy()
        positions[deformation.nodes] += deformation.displacement[row]
        return positions

    def tool(self, tool: Probe | Blade, touch: Touch, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Tip (3,) [m] and pose T_world_tool (4, 4).

        Of a tool that pushes: resting on the deformed surface, lifted off where it is idle.
        """
        if self.scene.posed:
            return self.scene.tip(self.site, touch), self.scene.pose(self.site, touch)
        inward = self.site.direction(replace(touch, tilt=(0.0, 0.0)))
        lift = AIR * max(0.0, 1.0 - touch.force / 0.02)
        tip = self.scene.contact(self.site, touch).carried(positions) - lift * inward
        return tip, tool.pose(tip, inward, self.site.right)


def gauged(tip: np.ndarray, hidden: Layer) -> Gauge:
    """From a tip (3,) [m] to the nearest point of a hidden surface."""
    surface = trimesh.Trimesh(hidden.vertices, hidden.triangles, process=False)
    return Gauge(tip, trimesh.proximity.closest_point_naive(surface, tip[None])[0][0])


def labelled(frame: Frame, name: str, error: float | None = None) -> np.ndarray:
    """The shown picture (H, W, 3) with a panel: deformer, what acts, milliseconds by stage, and error [m] if known.

    An answer that may not be relied on looks like any other, so the panel says it.
    """
    stages = "  ".join(f"{stage} {1e3 * seconds:.1f}" for stage, seconds in frame.seconds.items())
    acts = told(frame.loads, frame.deformation)
    lines = [f"{name}   t {frame.time:.2f} s   tumour moved {1e3 * frame.moved:.2f} mm"]
    lines += [*([acts] if acts else []), f"ms: {stages}"]
    if error is not None:
        lines.append(f"error against FEM: {1e3 * error:.3f} mm (frame {frame.number})")
    outcome = frame.deformation.outcome[0]
    if not outcome.good:
        lines.append(outcome.value)
    return panel(frame.shown, lines)
