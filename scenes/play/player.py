"""The loop: a scripted tool, a deformer and a camera make one frame after the other."""

from __future__ import annotations

import time as clock
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ar.optics.camera import Camera
from ar.overlay.composite import Overlaid, composite, draw_points, head_lines
from ar.overlay.gauge import Gauge
from ar.overlay.hud import NARROW, folded, lay
from ar.overlay.legend import Names
from ar.overlay.marks import Cover, Marks, Trace, Words
from ar.overlay.styles import Style
from ar.rendering.layer import Layer
from ar.rendering.real_picture import vignetted
from ar.rendering.renderer import Picture
from sim.deformation import Deformation, Deformer
from sim.effects import remember
from sim.geometry.ball_at_rest import resting_tip
from sim.geometry.closest_point import closest
from sim.geometry.surface import encloses
from sim.loads import Loads, stacked
from surrogate.model.guarded import answering
from surrogate.model.learned import Learned

from ..script.scene import Scene
from ..script.site import Site
from ..script.tool import Instrument, Probe
from ..script.tool_paths import Touch, lifted
from ..script.uncertainty import NOT_KNOWN, TumourError, Uncertainty
from .cortex_layers import COTTON, GLOVE
from .frame_text import acting, doubt_of, error_lines
from .observer import Estimate
from .stage import CORTEX, ESTIMATED_LINES, OPENING, PREDICTED_LINES, TOOL, Stage
from .tip_reading import reading

REFUSED = "what is seen was refused, and the scan is shown: do not rely on it"
# Strokes and gaps of the outlines of the truth and of the ellipsoid [pixel].
TRUE_STROKES, ELLIPSOID_STROKES = (12, 4), (8, 5)
COVERS = (TOOL, COTTON, GLOVE)
"""What is drawn in front of the overlay."""
IN_BONE = "the bone is where this push needs the tool: do not rely on it"
# Tissue may carry a tool into the bone's edge by so much before it is drawn elsewhere, and before its load counts as
# none that a tool can make [m].
CARRIED, BLOCKED = 0.5e-3, 2e-3
# A picture of fewer pixels in width has its lines of errors in few words.
FEW = 480
# Displacement below which a brain is undeformed [m].
STILL = 1e-6
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
        The picture with the predicted tumour in it (H, W, 3) uint8, where the scan had it, and the frame's number.
    taken, named
        (H, W) uint8: above 0 where lines and words stand in it; and whether a legend names the lines.
    distance
        From the tool's tip to the tumour's predicted surface [m]; None without a tool.
    distance_error
        How far that may be from what the finite elements say [m]; None where nobody knows.
    inside
        Whether the tip is in the tumour: the distance is then to the surface round it.
    moved
        Mean distance of the tumour's predicted surface from where the scan has it [m]; by an estimate, its middle's.
    moved_error
        How far that may be from the tumour's in the patient [m], with a probability of 95 %; None where nobody knows.
    model_error
        In 95 of 100 loads no point of the tumour is farther [m] from where the model's finite elements have it. None of
        these themselves, and where nobody knows.
    tumour_error
        How far the tumour may be from where it is drawn, whatever answers.
    doubt
        Why the answer may not be relied on, in the words that are in the picture; empty where it may.
    acts
        What acts, and what its tool reads, in words; empty where time alone goes on.
    head
        The lines at the picture's head: the errors of model and tumour.
    remark
        What else is said in the picture, as of a tool that the bone stops; mostly empty.
    seconds
        Wall time by stage, see `STAGES`; of an estimate too, as "locate".
    estimate
        Where the tumour is by what is seen, in a scene with a sight: that is drawn, and `deformation` is the truth.
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
    taken: np.ndarray
    named: bool
    distance: float | None
    distance_error: float | None
    inside: bool
    moved: float
    moved_error: float | None
    model_error: float | None
    tumour_error: TumourError
    doubt: str
    acts: str
    head: tuple[str, ...]
    remark: str
    seconds: Mapping[str, float]
    estimate: Estimate | None = None


@dataclass(frozen=True, eq=False)
class HeldTool:
    """Where a tool is drawn: tip (3,) [m], and T_world_tool pose (4, 4).

    beyond [m]: how far inside the bone its load needs it.
    """

    tip: np.ndarray
    pose: np.ndarray
    beyond: float


@dataclass(frozen=True, eq=False)
class Player:
    """A scene on a stage with one deformer. `draw` is a pure function of time, touch and the previous answer.

    Not `composed`: no overlay and no words are drawn, and `Frame.shown` is the picture itself.
    """

    stage: Stage
    deformer: Deformer
    style: Style = "window"
    uncertainty: Uncertainty | None = None
    composed: bool = True

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
        """The scene's camera as it starts."""
        return self.scene.viewpoint.camera(self.site)

    def camera_at(self, time: float) -> Camera:
        """The scene's camera at a time [s]: one that stays is the same, whose backdrop is kept."""
        view = self.scene.viewpoint
        return self.camera if view.path is None else view.camera(self.site, time)

    @cached_property
    def remembers(self) -> bool:
        """Whether an answer depends on the one before it."""
        solved = not isinstance(self.deformer, Learned)
        return self.follows or (solved and remember(self.scene.effects_on(self.site.anatomy)))

    @cached_property
    def follows(self) -> bool:
        """Whether a trained model plays that follows its tissue in time."""
        return isinstance(self.deformer, Learned) and bool(self.deformer.series)

    def touch(self, number: int) -> Touch:
        """What the script's hand asks for in a frame."""
        return self.scene.path(float(self.scene.times[number]))

    def loads(self, number: int, touch: Touch | None = None) -> Loads:
        """What acts in a frame; `touch` in place of the script's."""
        return self.scene.loads(self.site, touch or self.touch(number), float(self.scene.times[number]))

    def answer(self, loads: Loads, last: Deformation | None = None) -> Deformation:
        """The deformer's answer, from the last one: a learnt model's at the drawn vertices, which are all it knows."""
        if isinstance(self.deformer, Learned):
            return self.deformer.deform(loads, start=last if self.follows else None, at=self.stage.nodes)
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
        positions = self.positions(deformation)
        held = None if self.scene.tool is None else self.tool(self.scene.tool, touch, positions)
        stage, camera = self.stage.at(loads), self.camera_at(float(loads.times[0]))
        picture = stage.picture(camera, positions, None if held is None else held.pose)
        field = self.scene.viewpoint.field
        picture = picture if field is None else vignetted(picture, field)
        corners = stage.corners(None if held is None else held.pose)
        estimate = None if stage.observer is None else stage.observer.estimate(number, positions, corners)
        # What an observer draws to see it is no part of the estimate.
        seen, located = clock.perf_counter(), 0.0 if estimate is None else estimate.seconds
        tumour, rest = stage.tumour(_believed(positions, estimate)), stage.tumour_at_rest
        doubt = doubt_of(deformation.outcome[0]) or (IN_BONE if held is not None and held.beyond > BLOCKED else "")
        doubt = doubt or (REFUSED if estimate is not None and estimate.location is None else "")
        gauge = None if held is None else self._gauge(held, loads, deformation, tumour)
        promised = None if doubt else self._promised(deformation)
        error = NOT_KNOWN if doubt else self._tumour_error(touch, loads, promised or 0.0, estimate)
        shown = None if gauge is None else replace(gauge, error=error.bound)
        traces = () if estimate is None else traces_of(estimate, stage.truth(positions))
        moved = None if estimate is None or estimate.location is None else (estimate.moved, estimate.location.p95)
        motion = float(np.linalg.norm(tumour.vertices - rest.vertices, axis=1).mean())
        if estimate is None and error.moved is not None and not is_undeformed(deformation):
            moved = motion, error.moved
        band = 0.0 if estimate is not None else error.bound or 0.0
        trained = answering(self.deformer, deformation) is not None
        lines = error_lines(promised, error, trained, doubt, camera.width < FEW)
        head = head_lines(lines, picture.segmentation == TOOL)
        remarks = self.scene.stopped(self.site, touch), "" if estimate is None else estimate.words
        remark = "; ".join(words for words in remarks if words)
        if self.composed:
            marks = Marks(band, shown, rest, traces)
            words = Words(doubt, head, names_of(estimate), moved, error.bound)
            over = composite(picture, camera, tumour, self.style, Cover(COVERS, OPENING), marks, words)
            if estimate is not None and self.style != "none":
                draw_points(over, camera, estimate.observation.now, picture.segmentation == CORTEX)
            annotate(over, number, remark)
        else:
            over = Overlaid(picture.colour, np.zeros((camera.height, camera.width), np.uint8))
        spent = seconds, seen - begun - located, clock.perf_counter() - seen
        took = dict(zip(STAGES, spent, strict=True)) | ({} if estimate is None else {"locate": located})
        how_far, moved_error = (motion, None) if moved is None else moved
        return Frame(
            number=number, time=float(loads.times[0]), touch=touch, loads=loads, deformation=deformation, camera=camera,
            pose=None if held is None else held.pose, tip=None if held is None else held.tip,
            picture=picture, shown=over.colour, taken=over.taken, named=over.named,
            distance=None if gauge is None else gauge.distance, distance_error=None if gauge is None else gauge.error,
            inside=gauge is not None and gauge.inside, moved=how_far, moved_error=moved_error,
            model_error=promised, tumour_error=error, doubt=doubt,
            acts=acting(loads, deformation, self.site.anatomy.mesh.nodes), head=tuple(head), remark=remark,
            seconds=took, estimate=estimate,
        )  # fmt: skip

    def _gauge(self, held: HeldTool, loads: Loads, answer: Deformation, tumour: Layer) -> Gauge:
        """From the tip to the tumour, and how far off that may be as far as the deformer knows."""
        gauge = gauged(held.tip, tumour)
        read = None if held.beyond > CARRIED else reading(self.deformer, loads, answer, self.scene.tool, gauge.distance)
        return gauge if read is None else replace(gauge, read=read.distance, error=read.bound)

    def _promised(self, answer: Deformation) -> float | None:
        """What a model promises of an answer against its finite elements [m], of this load if it can; else None."""
        model = answering(self.deformer, answer)
        if model is None:
            return None
        of_load = float(answer.bound[0, 0])
        bound = of_load if np.isfinite(of_load) else model.bound
        return bound if np.isfinite(bound) else None

    def _tumour_error(self, touch: Touch, loads: Loads, promised: float, estimate: Estimate | None) -> TumourError:
        """How far the tumour may be off: known where the script has the tool, and what sees the brain knows more."""
        time = float(loads.times[0])
        scripted = self.uncertainty is not None and touch == self.scene.path(time)
        error = self.uncertainty.at(time, promised) if self.uncertainty is not None and scripted else NOT_KNOWN
        return (
            error
            if estimate is None
            else replace(error, observed=estimate.worst, registration=estimate.observation.rigid)
        )

    def frames(self, every: int = 1, together: int = 1) -> Iterator[Frame]:
        """The frames of the scene, or every so many of them.

        A model whose answers do not depend on each other gives those of so many frames `together`. It takes a quarter
        of the time, and the first frame waits for the last answer.
        """
        numbers = range(0, len(self.scene.times), every)
        if together == 1 or self.remembers or not isinstance(self.deformer, Learned):
            last = None
            for number in numbers:
                frame = self.draw(number, float(self.scene.times[number]), self.touch(number), last)
                last = frame.deformation
                yield frame
            return
        for first in range(0, len(numbers), together):
            some = numbers[first : first + together]
            begun, asked = clock.perf_counter(), [self.loads(number) for number in some]
            answers = self.answer(stacked(asked))
            seconds = (clock.perf_counter() - begun) / len(some)
            for row, (number, loads) in enumerate(zip(some, asked, strict=True)):
                yield self.drawn(number, self.touch(number), loads, answers.rows(np.array([row])), seconds)

    def positions(self, deformation: Deformation, row: int = 0) -> np.ndarray:
        """Where all mesh vertices are (V, 3) [m] in one load case; what the deformer does not know is at rest."""
        positions = self.site.anatomy.mesh.nodes.copy()
        positions[deformation.nodes] += deformation.displacement[row]
        return positions

    def believed(self, frame: Frame) -> np.ndarray:
        """Where all mesh vertices are (V, 3) [m] by what is drawn: the tumour's, in a scene with a sight, by that."""
        return _believed(self.positions(frame.deformation), frame.estimate)

    def tool(self, tool: Instrument, touch: Touch, positions: np.ndarray) -> HeldTool:
        """Where the tool is: of one that pushes, where it comes to rest on the deformed cortex from outside.

        It is lifted off where it is idle. Tissue that is drawn aside may carry it to the bone's edge, which stops it.
        """
        if self.scene.posed:
            return HeldTool(self.scene.tip(self.site, touch), self.scene.pose(self.site, touch), 0.0)
        inward = self.site.axis
        carried = self.scene.contact(self.site, touch).carried(positions)
        inside = self.site.within(carried, tool.radius)
        beyond = float(np.linalg.norm(inside - carried))
        tip = through = inside if beyond > CARRIED else carried
        if isinstance(tool, Probe):
            tip = resting_tip(positions, self.site.anatomy.open_surface, through, inward, tool.radius)
        tip = tip - lifted(touch.force) * inward
        pose = tool.pose(tip, inward, self.site.right)
        return HeldTool(tip, pose, beyond)


def is_undeformed(deformation: Deformation) -> bool:
    """Return True if nothing moves by more than a micrometre: there is no motion whose error could be given."""
    return bool(np.abs(deformation.displacement).max(initial=0.0) < STILL)


def _believed(positions: np.ndarray, estimate: Estimate | None) -> np.ndarray:
    return positions if estimate is None else estimate.carried(positions)


def traces_of(estimate: Estimate, truth: Layer) -> tuple[Trace, ...]:
    """What is drawn beside an estimate: its ellipsoid, and the tumour's true surface with its middle."""
    ellipsoid, true = estimate.ellipsoid(), Trace(truth, TRUE_STROKES, estimate.middle + estimate.true)
    if ellipsoid is None:
        return (true,)
    return Trace(ellipsoid, ELLIPSOID_STROKES, estimate.middle + estimate.motion), true


def names_of(estimate: Estimate | None) -> Names:
    """What the lines of a picture are called; an estimate that knows nothing has no ellipsoid."""
    if estimate is None:
        return PREDICTED_LINES
    return ESTIMATED_LINES if estimate.location is not None else replace(ESTIMATED_LINES, traces=("truth",))


def gauged(tip: np.ndarray, hidden: Layer) -> Gauge:
    """From a tip (3,) [m] to the nearest point of a hidden surface, and whether it is inside."""
    corners = hidden.vertices[hidden.triangles]
    return Gauge(tip, closest(tip[None], corners).point[0], inside=encloses(corners, tip))


def annotate(over: Overlaid, number: int, remark: str) -> None:
    """Write into a composite picture, in place: a remark at its foot, and a frame's number."""
    height, width = over.taken.shape
    lay(over.colour, over.taken, folded(remark, NARROW * width), (0, height))
    lay(over.colour, over.taken, [f"frame {number}"], (width, height))
