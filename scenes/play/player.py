"""Player of a scene: tool input, deformation, rendering and overlay of each frame."""

import time as clock
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ar.optics.camera import Camera
from ar.overlay.composite import Overlaid, composite, draw_points, wrap_header
from ar.overlay.gauge import DistanceGauge
from ar.overlay.legend import LegendNames
from ar.overlay.marks import ImageText, MarkOutline, Marks, Occluders
from ar.overlay.styles import Style
from ar.rendering.layer import Layer
from ar.rendering.renderer import Picture
from sim.deformation import Deformation, Deformer
from sim.effects import has_history
from sim.families.models import LinearModel
from sim.geometry.closest_point import find_closest_points
from sim.geometry.first_contact import find_resting_tip
from sim.geometry.surface import is_enclosing
from sim.loads import Loads, stack
from surrogate.locating.calibration import RADIUS_SQUARED
from surrogate.model.guarded import find_first_model
from surrogate.model.learned import Learned

from ..script.craniotomy_frame import CraniotomyFrame
from ..script.registration import REGISTRATIONS
from ..script.scene import Scene
from ..script.tool import Instrument, Probe
from ..script.tool_paths import Touch, compute_tool_height
from ..script.uncertainty import NOT_KNOWN, MotionError, TumourError, Uncertainty
from .cortex_layers import COTTON, GLOVE
from .family_record import FamilyFigures
from .frame_text import annotate_image, describe_outcome, format_active_loads, format_errors, is_by_other_family
from .observer import TumourEstimate
from .stage import CORTEX, ESTIMATED_LINES, OPENING, PREDICTED_LINES, SIMULATED, TOOL, Stage
from .tip_reading import predict_tip_distance

REJECTED_WARNING = "observation rejected, and the scan is shown: do not rely on it"  # Warning in the image.
TRUE_STROKES = (12, 4)  # Stroke and gap lengths of the reference's outline [pixel].
ELLIPSOID_STROKES = (8, 5)  # Stroke and gap lengths of the ellipsoid's outline [pixel].
OCCLUDER_LABELS = (TOOL, COTTON, GLOVE)
"""Layers drawn in front of the overlay."""
BONE_WARNING = "blocked by bone at the craniotomy edge: do not rely on it"  # Warning in the image.
# Largest penetration into the craniotomy edge that tissue carries [m]: beyond, the tool is drawn elsewhere.
CARRIED_DEPTH = 0.5e-3
BLOCKED_DEPTH = 2e-3  # Penetration into the craniotomy edge above which a load counts as infeasible [m].
NARROW_IMAGE_WIDTH = 480  # Image width below which the error lines are short [pixel].
MOTION_TOLERANCE = 1e-6  # Largest displacement of a brain that counts as undeformed [m].
STAGES = ("deform", "render", "overlay")
"""Stages of a frame that are timed."""


@dataclass(frozen=True, eq=False)
class Frame:
    """Rendered frame of a scene, with its solution, distances and errors.

    Parameters
    ----------
    number, time
        Frame number, which starts at 0, and time [s].
    touch, loads
        Requested tool input, and the resulting loads on the tissue.
    deformation
        Solution computed by the deformer.
    camera
        Camera with which the image was rendered.
    pose, tip
        T_world_tool (4, 4), and contact point of the tool (3,) [m]; None if the scene has no tool.
    picture
        The camera image without overlay.
    shown
        The image (H, W, 3) uint8 with the predicted tumour, its position in the scan, and the frame number.
    taken, named
        `taken` (H, W) uint8 is above 0 on lines and text. `named` is True if a legend names the lines.
    distance
        Distance from the tool's tip to the tumour's predicted surface [m]; None without a tool.
    distance_error
        Bound on the difference of `distance` from FEM [m]; None if not available.
    inside
        True if the tip is inside the tumour; `distance` is then measured from inside to the tumour's surface.
    moved
        Mean displacement of the tumour's predicted surface [m]; with an estimate, displacement of the centroid.
    moved_error
        95 % bound on the difference of `moved` from the motion in the patient [m]; None if not available.
    model_error
        95th percentile over loads of the maximum tumour vertex error relative to the model's FEM [m]. None for FEM
        and if not available.
    tumour_error
        Expected error of the drawn tumour position relative to the patient, for any deformer.
    doubt
        Reason why the solution is unreliable, as written in the image; empty if it is reliable.
    acts
        Description of the active loads and of the measured tool force; empty without loads.
    head
        The lines at the top of the image: errors of model and tumour.
    remark
        Further text in the image, for example that bone stops the tool; usually empty.
    seconds
        Wall time [s] of each step in `STAGES`; with an estimate, "locate" is its time.
    estimate
        Estimated and drawn tumour position in a scene with an observation model; `deformation` is then the truth.
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
    estimate: TumourEstimate | None = None


@dataclass(frozen=True, eq=False)
class PlacedTool:
    """Drawn position of a tool: tip (3,) [m], and pose T_world_tool (4, 4).

    `bone_penetration` [m]: depth inside the bone that the tool would need for its load.
    """

    tip: np.ndarray
    pose: np.ndarray
    bone_penetration: float


@dataclass(frozen=True, eq=False)
class Player:
    """Player of one scene with one deformer. `draw` is a pure function of number, time, touch and last solution.

    If `composed` is False, `Frame.shown` is the camera image without overlay and text. If `coarse` is True, the camera
    image is rendered with half the resolution and enlarged; the overlay keeps the full resolution.

    Examples
    --------
    >>> from scenes import find_scene, open_theatre
    >>> player = open_theatre(device="cpu").build_player("series-gp", find_scene("press"))
    >>> frame = player.draw(60, 2.0, player.get_touch(60))
    >>> print(f"{frame.shown.shape}, the tumour moves by {1e3 * frame.moved:.1f} mm")
    (600, 800, 3), the tumour moves by 1.3 mm
    """

    stage: Stage
    deformer: Deformer
    style: Style = "window"
    uncertainty: Uncertainty | None = None
    motion_error: MotionError | None = None
    composed: bool = True
    coarse: bool = False
    recorded: FamilyFigures | None = None

    @property
    def scene(self) -> Scene:
        """The scene that is played."""
        return self.stage.scene

    @property
    def site(self) -> CraniotomyFrame:
        """Coordinate system of the craniotomy of the scene's anatomy."""
        return self.stage.site

    @property
    def camera(self) -> Camera:
        """Initial camera of the scene."""
        return self.stage.camera

    def get_camera(self, time: float) -> Camera:
        """Return the scene's camera at a time [s]; a static camera is always the same object (for caches)."""
        return self.camera if self.scene.viewpoint.path is None else self.scene.viewpoint.build_camera(self.site, time)

    @cached_property
    def remembers(self) -> bool:
        """True if a solution depends on the previous solution."""
        solved = not isinstance(self.deformer, Learned)
        return self.follows or (solved and has_history(self.scene.get_effects_on(self.site.anatomy)))

    @cached_property
    def follows(self) -> bool:
        """True if the deformer is a trained model that integrates relaxing tissue in time."""
        return isinstance(self.deformer, Learned) and bool(self.deformer.series)

    def get_touch(self, number: int) -> Touch:
        """Return the scripted tool input of frame `number`."""
        return self.scene.path(float(self.scene.times[number]))

    def build_loads(self, number: int, touch: Touch | None = None) -> Loads:
        """Return the loads of frame `number`; `touch` replaces the scripted tool input."""
        return self.scene.build_loads(self.site, touch or self.get_touch(number), float(self.scene.times[number]))

    def compute_deformation(self, loads: Loads, last: Deformation | None = None) -> Deformation:
        """Compute the deformation, starting from `last`; `Learned` and `LinearModel` return drawn vertices only."""
        if isinstance(self.deformer, Learned | LinearModel):
            return self.deformer.deform(loads, start=last if self.follows else None, at=self.stage.drawn_vertices)
        return self.deformer.deform(loads, start=last)

    def draw(self, number: int, time: float, touch: Touch, last: Deformation | None = None) -> Frame:
        """Compute and draw frame `number` for a tool input at a time [s]; the deformer starts from `last`."""
        begun = clock.perf_counter()
        loads = self.scene.build_loads(self.site, touch, time)
        deformation = self.compute_deformation(loads, last)
        return self.draw_frame(number, touch, loads, deformation, clock.perf_counter() - begun)

    def draw_frame(self, number: int, touch: Touch, loads: Loads, deformation: Deformation, seconds: float) -> Frame:
        """Draw frame `number` from the solution of its loads, which was computed in `seconds`."""
        begun = clock.perf_counter()
        positions = self.compute_positions(deformation)
        held = None if self.scene.tool is None else self.place_tool(self.scene.tool, touch, positions)
        stage, camera = self.stage.select_stage(loads), self.get_camera(float(loads.times[0]))
        drawn = stage.without_fine_cortex if self.style == "rings" else stage  # rings lie on the FEM surface
        pose, estimate = None if held is None else held.pose, None
        picture = drawn.render_view(camera, positions, pose, self.coarse, number)
        if stage.observer is not None:
            estimate = stage.observer.estimate(number, positions, stage.compute_tool_corners(pose))
        seen, located = clock.perf_counter(), 0.0 if estimate is None else estimate.seconds  # without rendering
        tumour, rest = stage.build_tumour(_estimate_positions(positions, estimate)), stage.tumour_at_rest
        doubt = describe_outcome(deformation.outcome[0]) or (
            BONE_WARNING if held is not None and held.bone_penetration > BLOCKED_DEPTH else ""
        )
        doubt = doubt or (REJECTED_WARNING if estimate is not None and estimate.location is None else "")
        gauge = None if held is None else self._measure_tip_gauge(held, loads, deformation, tumour)
        promised = None if doubt else self._get_model_error(deformation)
        motion = float(np.linalg.norm(tumour.vertices - rest.vertices, axis=1).mean())
        bound = promised or (1e-3 * self.recorded.p95_mm if self.recorded else 0.0)
        error = NOT_KNOWN if doubt else self._compute_tumour_error(touch, loads, motion, bound, estimate)
        shown = None if gauge is None else replace(gauge, error=error.bound)
        traces = () if estimate is None else list_estimate_traces(estimate, stage.build_fem_tumour(positions))
        moved = (estimate.motion_length, estimate.location.p95) if estimate and estimate.location else (motion, None)
        if estimate is None and error.moved is not None and not is_undeformed(deformation):
            moved = motion, error.moved
        band = 0.0 if estimate is not None else error.bound or 0.0
        trained = find_first_model(self.deformer, deformation) is not None or is_by_other_family(deformation)
        lines = format_errors(promised, error, trained, doubt, camera.width < NARROW_IMAGE_WIDTH, self.recorded)
        head = wrap_header(lines, picture.segmentation == TOOL)
        remarks = self.scene.describe_stop(self.site, touch), "" if estimate is None else estimate.remark
        remark = "; ".join(words for words in remarks if words)
        if self.composed:
            marks = Marks(band, shown, stage.smooth_tumour_at_rest, traces)
            words = ImageText(doubt, head, get_legend_names(estimate), moved, error.bound)
            outline, cover = stage.smooth_tumour(tumour), Occluders(OCCLUDER_LABELS, OPENING)
            over = composite(picture, camera, outline, self.style, cover, marks, words)
            if estimate is not None and self.style != "none":
                draw_points(over, camera, estimate.observation.now, picture.segmentation == CORTEX)
            annotate_image(over, number, remark)
        else:
            over = Overlaid(picture.colour, np.zeros((camera.height, camera.width), np.uint8))
        spent = seconds, seen - begun - located, clock.perf_counter() - seen
        took = dict(zip(STAGES, spent, strict=True)) | ({} if estimate is None else {"locate": located})
        return Frame(
            number=number, time=float(loads.times[0]), touch=touch, loads=loads, deformation=deformation, camera=camera,
            pose=pose, tip=None if held is None else held.tip, picture=picture, shown=over.colour, taken=over.taken,
            distance=None if gauge is None else gauge.distance, distance_error=None if gauge is None else gauge.error,
            named=over.named, inside=gauge is not None and gauge.is_inside, moved=moved[0], moved_error=moved[1],
            model_error=promised, tumour_error=error, doubt=doubt,
            acts=format_active_loads(loads, deformation, self.site.anatomy.mesh.nodes), head=tuple(head), remark=remark,
            seconds=took, estimate=estimate,
        )  # fmt: skip

    def _measure_tip_gauge(self, tool: PlacedTool, loads: Loads, result: Deformation, tumour: Layer) -> DistanceGauge:
        """Measure the distance from tip to tumour, with the deformer's error bound if it is available."""
        gauge = measure_tip_gauge(tool.tip, tumour)
        if tool.bone_penetration > CARRIED_DEPTH:
            return gauge
        read = predict_tip_distance(self.deformer, loads, result, self.scene.tool, gauge.distance)
        return gauge if read is None else replace(gauge, reading=read.distance, error=read.bound)

    def _get_model_error(self, deformation: Deformation) -> float | None:
        """Return a trained model's error bound relative to FEM [m], of this load if available; None without bound."""
        model = find_first_model(self.deformer, deformation)
        if model is None:
            return None
        of_load = float(deformation.bound[0, 0])
        bound = of_load if np.isfinite(of_load) else model.bound
        return bound if np.isfinite(bound) else None

    def _compute_tumour_error(
        self, touch: Touch, loads: Loads, motion: float, model_bound: float, estimate: TumourEstimate | None
    ) -> TumourError:
        """Return the tumour position error: from the ensemble if the tool follows its script, else from the motion [m].

        The bound of an estimate from observations is added as `observed`.
        """
        time = float(loads.times[0])
        scripted = self.uncertainty is not None and touch == self.scene.path(time)
        error, registration = NOT_KNOWN, self.scene.registration
        if self.uncertainty is not None and scripted:
            error = self.uncertainty.evaluate(time, model_bound, registration)
        elif self.motion_error is not None:
            error = self.motion_error.evaluate(motion, model_bound, registration)
        if estimate is None:
            return error
        deviation, bound = REGISTRATIONS[registration], estimate.error_bound
        worst = None if bound is None else float(np.hypot(bound, RADIUS_SQUARED**0.5 * deviation))
        return replace(error, observed=worst, registration=deviation)

    def play_frames(self, every: int = 1, together: int = 1) -> Iterator[Frame]:
        """Yield every `every`-th frame of the scene (default: all frames).

        A trained model with independent solutions computes `together` frames in one batch. This takes a quarter of the
        time, but the first frame of a batch waits for all its solutions.
        """
        numbers = range(0, len(self.scene.times), every)
        if together == 1 or self.remembers or not isinstance(self.deformer, Learned):
            last = None
            for number in numbers:
                frame = self.draw(number, float(self.scene.times[number]), self.get_touch(number), last)
                last = frame.deformation
                yield frame
            return
        for first in range(0, len(numbers), together):
            some = numbers[first : first + together]
            begun, asked = clock.perf_counter(), [self.build_loads(number) for number in some]
            answers = self.compute_deformation(stack(asked))
            seconds = (clock.perf_counter() - begun) / len(some)
            for row, (number, loads) in enumerate(zip(some, asked, strict=True)):
                yield self.draw_frame(number, self.get_touch(number), loads, answers.select(np.array([row])), seconds)

    def compute_positions(self, deformation: Deformation, row: int = 0) -> np.ndarray:
        """Return positions (V, 3) [m] of all mesh vertices in load case `row`; undeformed where there is no result."""
        positions = self.site.anatomy.mesh.nodes.copy()
        positions[deformation.nodes] += deformation.displacement[row]
        return positions

    def estimate_positions(self, frame: Frame) -> np.ndarray:
        """Return the drawn positions (V, 3) [m] of all mesh vertices; an estimate replaces the tumour's positions."""
        return _estimate_positions(self.compute_positions(frame.deformation), frame.estimate)

    def place_tool(self, tool: Instrument, touch: Touch, positions: np.ndarray) -> PlacedTool:
        """Compute the drawn pose of a tool. A pushing tool rests on the outside of the deformed cortex.

        An idle tool is lifted above the cortex. The craniotomy edge stops a tool that moves with displaced tissue.
        """
        if self.scene.posed:
            return PlacedTool(self.scene.compute_tip(self.site, touch), self.scene.compute_pose(self.site, touch), 0.0)
        inward = self.site.axis
        carried = self.scene.find_contact(self.site, touch).locate(positions)
        inside = self.site.clip_to_opening(carried, tool.radius)
        beyond = float(np.linalg.norm(inside - carried))
        tip = through = inside if beyond > CARRIED_DEPTH else carried
        if isinstance(tool, Probe):
            tip = find_resting_tip(positions, self.site.anatomy.open_surface, through, inward, tool.radius)
        tip = tip - compute_tool_height(touch.force) * inward
        pose = tool.pose(tip, inward, self.site.right)
        return PlacedTool(tip, pose, beyond)

    # Former names, for one release.
    camera_at, touch, loads, answer = get_camera, get_touch, build_loads, compute_deformation
    drawn, frames, positions, believed = draw_frame, play_frames, compute_positions, estimate_positions
    tool = place_tool


def is_undeformed(deformation: Deformation) -> bool:
    """Return True if no vertex moves by 1 micrometre or more; an error of the motion is then meaningless."""
    return bool(np.abs(deformation.displacement).max(initial=0.0) < MOTION_TOLERANCE)


def _estimate_positions(positions: np.ndarray, estimate: TumourEstimate | None) -> np.ndarray:
    return positions if estimate is None else estimate.place_tumour(positions)


def list_estimate_traces(estimate: TumourEstimate, tumour: Layer) -> tuple[MarkOutline, ...]:
    """Build the outlines of an estimate: its ellipsoid if accepted, and the true tumour surface; each with a centre."""
    ellipsoid = estimate.build_ellipsoid()
    true = MarkOutline(tumour, TRUE_STROKES, estimate.centroid + estimate.true_motion)
    if ellipsoid is None:
        return (true,)
    return MarkOutline(ellipsoid, ELLIPSOID_STROKES, estimate.centroid + estimate.motion), true


def get_legend_names(estimate: TumourEstimate | None) -> LegendNames:
    """Return the legend's names of the lines in an image; a rejected estimate has no line of an ellipsoid."""
    if estimate is None:
        return PREDICTED_LINES
    return ESTIMATED_LINES if estimate.location is not None else replace(ESTIMATED_LINES, outlines=(SIMULATED,))


def measure_tip_gauge(tip: np.ndarray, surface: Layer) -> DistanceGauge:
    """Return the gauge from a tip (3,) [m] to the nearest surface point, and if the surface encloses the tip."""
    corners = surface.vertices[surface.triangles]
    return DistanceGauge(tip, find_closest_points(tip[None], corners).point[0], is_inside=is_enclosing(corners, tip))
