"""Synthetic videos of a scene with printed targets, by a realistic camera, and their ground truth."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter1d
from scipy.spatial.transform import Rotation

from ar.optics.calibration import Calibration
from ar.optics.camera import Camera, find_row_time, split_row_bands
from ar.optics.lens import Lens
from ar.rendering.layer import Layer
from ar.rendering.renderer import Renderer
from ar.tracking.registration import Registration
from ar.tracking.rigid import move_rigidly
from ar.tracking.synthetic_images import render_targets, stamp_time
from ar.tracking.targets import Target, build_patient_reference, build_tool_cube, find_window
from sim.errors import InputError
from sim.tools import BuiltIn

from ..play.player import Player
from ..play.stage import TOOL, TOOL_COLOUR
from ..script.craniotomy_frame import CraniotomyFrame
from ..script.viewpoint import OBLIQUE_VIEWPOINT, Viewpoint
from .registration_file import describe_scan
from .tracked_tool import TrackedTool

USUAL_CALIBRATION = Calibration(
    (1400.0, 1400.0), (620.0, 540.0), 1280, 960, Lens(-0.1, 0.02, 5e-4, -3e-4), "sulcus film"
)
"""Default camera of a video."""
VIEW = replace(OBLIQUE_VIEWPOINT, distance=0.32).calibrate(USUAL_CALIBRATION)
"""Viewpoint that shows the craniotomy, the reference near the craniotomy, and the tool's cube."""
# Centre of the reference relative to the craniotomy, to the right, up and outwards [m].
REFERENCE_POSITION = (-0.078, 0.010, 0.022)
REFERENCE_ROTATION = (28.0, -24.0)  # Rotation of the reference about x and y from the line of sight [deg].
CUBE_DISTANCE = 0.09  # Distance from the tool's tip up its shaft to the centre of its cube [m].
HAND_COLOUR = (196, 148, 128)  # Colour of a hand that covers a target (RGB).
BRIGHT_FACTOR = 12.0  # Factor on the brightness of an over-exposed image.
SMEAR_LENGTH = 41  # Length of a smear [pixel].
KINDS = {
    "reference": "a hand covers the patient's reference",
    "tool": "a hand covers the tool's cube",
    "bright": "the image is over-exposed",
    "smear": "the image is smeared by motion",
    "gap": "there are no images",
}
"""Descriptions of the disturbances of a video, by kind."""


def scale_distance(view: Viewpoint) -> Viewpoint:
    """Return the viewpoint at the distance at which a calibrated camera's image shows as much as with `VIEW`."""
    assert view.calibration is not None
    longer = (view.calibration.focal[1] / view.height) / (USUAL_CALIBRATION.focal[1] / USUAL_CALIBRATION.height)
    return replace(view, distance=longer * VIEW.distance)


def place_reference(site: CraniotomyFrame, camera: Camera) -> np.ndarray:
    """Return T_scan_patient (4, 4) [m] of a reference that is near the craniotomy and faces `camera`."""
    right, up, outwards = REFERENCE_POSITION
    middle = site.origin + right * site.right + up * site.up - outwards * site.axis
    T = np.eye(4)
    T[:3, :3] = (
        camera.T_camera_world[:3, :3].T @ Rotation.from_euler("xy", REFERENCE_ROTATION, degrees=True).as_matrix()
    )
    T[:3, 3] = middle - T[:3, :3] @ [*(0.5 * build_patient_reference().faces[0].size), 0.0]
    return T


@dataclass(frozen=True)
class Disturbance:
    """Disturbance of the images of a video, from a start time to an end time [s].

    Raises
    ------
    InputError
        The kind is not in `KINDS`, or the times are not in order.
    """

    kind: str
    start: float
    end: float

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"no trouble is called {self.kind!r}: choose one of {', '.join(KINDS)}.")
        if not 0.0 <= self.start < self.end < np.inf:
            raise InputError(f"{self.kind} is from {self.start:g} to {self.end:g} s: give two times in order.")


@dataclass(frozen=True)
class Artefacts:
    """Image degradation: standard deviations of blur [pixel] and noise [grey level of 255], and disturbances."""

    blur: float = 0.5
    noise: float = 2.0
    disturbances: tuple[Disturbance, ...] = ()
    seed: int = 0

    def list_disturbances(self, time: float) -> set[str]:
        """Return the kinds of the disturbances at a time [s]."""
        return {each.kind for each in self.disturbances if each.start <= time < each.end}


@dataclass(frozen=True, eq=False)
class VideoFrame:
    """Image of a synthetic video with its ground truth.

    Parameters
    ----------
    time
        Time of the image [s].
    image
        Image (H, W, 3) uint8.
    T_camera_scan, T_scan_tool
        True poses (4, 4) [m].
    displacement
        True displacements (n, 3) [m] of the tumour's surface vertices, in the order of `Stage.tumour_vertices`.
    """

    time: float
    image: np.ndarray
    T_camera_scan: np.ndarray
    T_scan_tool: np.ndarray
    displacement: np.ndarray


@dataclass(frozen=True, eq=False)
class Mounts:
    """Printed targets of a video: tool with its cube, and pose T_scan_patient (4, 4) [m] of the reference."""

    tool: TrackedTool
    T_scan_patient: np.ndarray


def mount_targets(player: Player) -> Mounts:
    """Place a cube on the scene's tool and a reference near the craniotomy; both face the initial camera.

    Raises
    ------
    InputError
        The scene has no tool on which a cube can be mounted.
    """
    scene, site, camera = player.scene, player.site, player.camera
    shape = None if scene.tool is None else scene.tool.shape
    if scene.tool is None or not isinstance(shape, BuiltIn):
        raise InputError(
            f"the scene {scene.name} has no ball, rod or blade that a cube could be put on: choose another."
        )
    touch = player.get_touch(0)
    pose = player.place_tool(scene.tool, touch, site.anatomy.mesh.nodes).pose
    T_tool_cube = np.eye(4)
    T_tool_cube[2, 3] = CUBE_DISTANCE
    towards = pose[:3, :3].T @ (camera.centre - pose[:3, :3] @ T_tool_cube[:3, 3] - pose[:3, 3])
    turn = np.arctan2(towards[1], towards[0]) - 0.25 * np.pi  # the edge between two sides of the cube faces the camera
    T_tool_cube[:3, :3] = Rotation.from_euler("z", turn).as_matrix()
    return Mounts(TrackedTool(shape, np.linalg.inv(T_tool_cube)), place_reference(site, camera))


def register_with_error(
    site: CraniotomyFrame, targets: Mounts, shift_mm: float, angle_deg: float, seed: int
) -> Registration:
    """Sample a registration of the reference to the scan, with one random rigid error.

    `shift_mm` and `angle_deg` are its standard deviations along and about each axis through the craniotomy's centre.
    """
    deviations = np.repeat([1e-3 * shift_mm, np.radians(angle_deg)], 3)
    error = deviations * np.random.default_rng([seed, 1]).standard_normal(6)
    centre = site.origin
    T = move_rigidly(np.linalg.inv(targets.T_scan_patient), centre, error)
    return Registration(T, np.diag(deviations**2), centre, 0.0, 0, scan=describe_scan(site.anatomy))


def render_frames(player: Player, mounts: Mounts, artefacts: Artefacts, step: int = 1) -> Iterator[VideoFrame]:
    """Render every `step`-th frame of a scene as a video image; the deformer's solutions are the ground truth.

    With a rolling shutter, each image row is rendered from its own camera pose, with tool and tissue at the image's
    time. The ground-truth camera of such an image is the camera of the row that shows the tumour's centroid.
    """
    tool, site, stage, last = player.scene.tool, player.site, player.stage, None
    assert tool is not None
    renderer: Renderer | None = None
    calibration = player.scene.viewpoint.calibration
    readout = 0.0 if calibration is None else calibration.readout
    rest = site.anatomy.mesh.nodes
    for number in range(0, len(player.scene.times), step):
        time, touch = float(player.scene.times[number]), player.get_touch(number)
        last = player.compute_deformation(player.build_loads(number, touch), last)
        wrong = artefacts.list_disturbances(time)
        if "gap" in wrong:
            continue
        positions = player.compute_positions(last)
        pose = player.place_tool(tool, touch, positions).pose
        held = Layer(
            "tool", TOOL, *mounts.tool.build_surface(pose), TOOL_COLOUR, gloss=0.8, shininess=90.0, casts_shadow=True
        )
        layers = [*stage.build_layers(positions, None), held]
        renderer = renderer or Renderer(layers, stage.lamp, stage.device)
        targets = [
            (build_tool_cube(), pose @ np.linalg.inv(mounts.tool.T_cube_tool)),
            (build_patient_reference(), mounts.T_scan_patient),
        ]
        view = partial(_render_image, renderer, [layer.vertices for layer in layers if not layer.still], targets, wrong)

        def camera_at(after: float, time: float = time) -> Camera:
            return player.get_camera(time + after)

        tumour = positions[stage.tumour_vertices]
        places = np.stack([tumour.mean(axis=0), site.origin, *(T[:3, 3] for _, T in targets)])
        shown = (
            view(player.get_camera(time))
            if readout == 0.0
            else np.concatenate([view(camera) for _, camera in split_row_bands(camera_at, readout, places)])
        )
        camera = camera_at(find_row_time(camera_at, readout, places[0]))
        moved = tumour - rest[stage.tumour_vertices]
        yield VideoFrame(
            time,
            stamp_time(_apply_disturbances(shown, artefacts, wrong, number), time),
            camera.T_camera_world,
            pose,
            moved,
        )


def _render_image(
    renderer: Renderer,
    vertices: Sequence[np.ndarray],
    targets: Sequence[tuple[Target, np.ndarray]],
    wrong: set[str],
    camera: Camera,
) -> np.ndarray:
    """Render a camera's image (H, W, 3) uint8 with targets at T_scan_target (4, 4); a hand covers those in `wrong`."""
    sharp = renderer.render(camera, vertices).colour
    shown = render_targets(sharp, camera, [each for each in targets if NAMES[each[0].name] not in wrong])
    for target, T in targets:
        if NAMES[target.name] in wrong:
            shown = _draw_hand(shown, camera, target, T)
    return shown


NAMES = {"tool": "tool", "patient": "reference"}
"""Kind of the disturbance that covers a target, by target name."""


def _draw_hand(colour: np.ndarray, camera: Camera, target: Target, T_scan_target: np.ndarray) -> np.ndarray:
    """Draw a hand in front of a target, and return the new image."""
    T = camera.T_camera_world @ T_scan_target
    outline = target.outline
    where = find_window(replace(camera, T_camera_world=np.eye(4)), outline @ T[:3, :3].T + T[:3, 3], 0.1, 0.0)
    out = colour.copy()
    if where is not None:
        out[where] = HAND_COLOUR
    return out


def _apply_disturbances(image: np.ndarray, noise: Artefacts, wrong: Sequence[str] | set[str], frame: int) -> np.ndarray:
    """Return an image with the disturbances of the whole image (over-exposure, smear), blur and noise."""
    out = image.astype(np.float32)
    if "bright" in wrong:
        out *= BRIGHT_FACTOR
    if "smear" in wrong:
        out = uniform_filter1d(out, SMEAR_LENGTH, axis=1)
    if noise.blur > 0.0:
        out = gaussian_filter(out, (noise.blur, noise.blur, 0.0))
    if noise.noise > 0.0:
        random = np.random.default_rng([noise.seed, frame])
        out = out + noise.noise * random.standard_normal(out.shape, np.float32)
    return np.clip(np.rint(out), 0.0, 255.0).astype(np.uint8)
