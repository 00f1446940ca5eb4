"""Recording of a scene as an episode in HDF5: camera images, tool poses and forces, and the tumour's motion.

Patient space is RAS [m]; the camera frame is OpenCV's (x right, y down, z forward). Read an image with
`cv2.imdecode(file["pictures/colour"][i], cv2.IMREAD_COLOR)`. Attributes describe each data set, its solver, and
tissue, element and tool: `finite_elements` as text, `tissue` and `element` for a program.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np

from ar.optics.camera import Camera
from ar.overlay.outlines import compute_silhouette
from sim.deformation import Deformation
from sim.errors import InputError
from sim.fem import Fem
from sim.loads import Loads, Posture, Pushed, Resected, Retracted, Touching
from sim.resected_fem import ResectedFem
from sim.runtime.atomic_files import check_disk_space, write_stream_atomically
from sim.runtime.versions import get_version
from surrogate.data.solution_rows import describe_tissue_source
from surrogate.model.guarded import find_model
from surrogate.model.learned import Learned

from ..play.deformers import PatientSetup
from ..play.player import STAGES, Frame, Player
from ..play.reference import BATCH_FRAMES, solve_reference_frames
from ..play.stage import NAMES, Stage
from .checksums import write_checksums
from .png import encode_png

FORMAT = "sulcus episode 2"  # Name and version of the file format.
DEPTH_SCALE = 1e-5
"""Resolution of the 16-bit depth images [m]; a depth of 0 means that nothing is visible."""
JPEG_QUALITY = 95  # JPEG quality of the images, 0 to 100.
PIXEL_BYTES = 1.5
"""Estimate of the compressed size of a frame's images [bytes per pixel]; the scenes `press` and `draw`: 0.9 to 1.0."""
# Meanings of the arrays of an episode, by path.
MEANINGS = {
    "pictures/colour": "JPEG bytes: camera image, BGR when decoded by OpenCV",
    "pictures/colour_right": "JPEG bytes: image of the right camera of a stereo pair",
    "pictures/overlay": "JPEG bytes: the colour image with an overlay of the predicted tumour",
    "pictures/segmentation": "PNG bytes, 8 bit: id of the visible object, see the root's `segmentation`",
    "pictures/tumour_mask": "PNG bytes, 8 bit: 1 in the silhouette of the predicted tumour, including hidden parts",
    "K": "pinhole camera matrix (3, 3) [pixel]; of a camera that zooms or focuses, as it starts",
    "K_of_frame": "(frames, 3, 3): the same in each frame, where the camera moves",
    "distortion": "(8,) k1 k2 p1 p2 k3 k4 k5 k6 of the lens, as cv2.projectPoints takes them; none without a lens",
    "bound": "(frames, 2): 95 % and 99 % bounds of the model's maximum tumour vertex error relative to "
    "its FEM; NaN: not available",
    "tumour_nodes": "mesh vertices of the rows of tumour_*", "tumour_left": "which of them are not cut out",
    "outcome_predicted": "outcome of the deformer", "outcome_fem": "outcome of FEM",
    "tumour_predicted": "positions, by the deformer, or by the locator if the scene has observations",
    "tumour_fem": "positions, by FEM, in the frames `fem_frames`",
    "cortex_nodes": "mesh vertices of the rows of cortex_*: the open cortex",
    "cortex_predicted": "positions, by the deformer", "cortex_rest": "positions in the scan",
    "cortex_fem": "positions, by FEM, in the frames `fem_frames`",
    "fem_frames": "numbers of the frames that FEM solved: the rows of *_fem",
    "force_read": "the force as a sensor reads it, with its noise",
    "T_camera_world_right": "(frames, 4, 4): that of the right eye of a stereo pair, whose left eye is the camera",
    "T_camera_world_tracked": "(frames, 4, 4): the same as a tracker has it, with its noise",
    "T_world_tool_tracked": "(frames, 4, 4): the tool's pose as a tracker has it, with its noise",
    "tumour_rest": "positions in the scan",
    "reaction_fem": "(frames, tools, 6): force that each tool exerts, and its moment about the tool's lowest point",
    "reaction_predicted": "(frames, tools, 6): the same by the deformer, if available",
    "reaction_bound": "(frames, 2): 95 % and 99 % bounds of the model's error of that force; NaN: not available",
    "time": "time since the start of the scene", "seconds": "duration of each stage of the image",
    "T_camera_world": "(frames, 4, 4): takes points of the world to the camera's frame: x_camera = T x_world",
    "T_world_tool": "(frames, 4, 4): takes points of the tool's own frame to the world: x_world = T x_tool",
    "force": "of the tool on the brain, in the world's frame",
    "pictures/depth": "PNG bytes, 16 bit: distance along the camera's z axis; 0 where nothing is seen",
    "contact": "where the tool pushes, on the cortex of the scan",
    "tip": "the tool's lowest point, along the open cortex's mean outward normal",
    "distance": "from the tool's tip to the predicted tumour, as displayed (a model may correct it)",
    "distance_error": "error of the model's `distance` relative to its FEM, exceeded in 5 % of the loads; "
    "NaN: not available",
    "model_error": "95 % bound of the maximum tumour vertex error relative to the model's FEM; "
    "NaN for FEM itself, or if not available",
    "tumour_error": "95 % bound of the maximum tumour surface error relative to the patient. NaN: not available",
    "tumour_error_unobserved": "the same bound without observations",
}  # fmt: skip
# Units of the arrays of an episode.
UNITS = {
    "time": "s", "T_camera_world": "m", "T_world_tool": "m", "tip": "m", "force": "N", "contact": "m",
    "distance": "m", "distance_error": "m", "model_error": "m", "tumour_error": "m", "tumour_error_unobserved": "m",
    "direction": "1", "csf_level": "m", "share": "1", "done": "1",
    "tumour_predicted": "m", "tumour_fem": "m", "tumour_rest": "m", "cortex_nodes": "1", "cortex_predicted": "m",
    "cortex_rest": "m", "cortex_fem": "m", "fem_frames": "1", "force_read": "N", "T_camera_world_right": "m",
    "T_camera_world_tracked": "m", "T_world_tool_tracked": "m", "colour_right": "JPEG", "bound": "m", "seconds": "s",
    "reaction_fem": "N, N m", "reaction_predicted": "N, N m", "reaction_bound": "N",
    "K": "pixel", "K_of_frame": "pixel", "distortion": "1",
    "pose": "m", "displacement": "m", "tumour_nodes": "1", "tumour_left": "1",
    "outcome_predicted": "text", "outcome_fem": "text", "colour": "JPEG", "overlay": "JPEG", "segmentation": "PNG",
    "tumour_mask": "PNG",
    "depth": f"{DEPTH_SCALE:g} m (PNG, 16 bit)",
}  # fmt: skip


@dataclass(frozen=True)
class EpisodeRecording:
    """Settings for the recording of a scene as an episode.

    Parameters
    ----------
    solved_every
        FEM solves every Nth frame as reference; None: FEM plays the scene, and its solutions are the reference.
    overlay
        True to store also the images with overlay.
    with_times
        True to store date and computing times; if False, equal scenes give equal bytes.
    add_noise
        Function that adds camera noise, given a number and a colour image (H, W, 3) uint8.
    read_sensors
        Function from the recorded columns to columns of noisy sensor readings, by name.
    attributes
        Further attributes of the file.
    fem
        Existing FEM solver for the reference; None: a new solver.
    """

    solved_every: int | None = 1
    overlay: bool = True
    with_times: bool = True
    add_noise: Callable[[int, np.ndarray], np.ndarray] = lambda number, colour: colour
    read_sensors: Callable[[Mapping[str, Any]], Mapping[str, np.ndarray]] = lambda columns: {}
    attributes: Mapping[str, str | int] = field(default_factory=dict)
    fem: Fem | ResectedFem | None = None


FULL_RECORDING = EpisodeRecording()
"""Default settings: all contents are recorded, and FEM solves every frame."""


def collect(
    path: Path,
    theatre: PatientSetup,
    player: Player,
    deformer: str,
    progress: Callable[[Iterable], Iterable],
    solved: Callable[[int], object] = lambda more: None,
    recording: EpisodeRecording = FULL_RECORDING,
) -> dict[str, object]:
    """Play a scene and write its episode, atomically; return a summary for JSON.

    `progress` wraps the iteration over the drawn frames; `solved` receives the number of newly solved frames.

    Raises
    ------
    InputError
        The file cannot be written, or the disk has too little space.
    """
    total = len(player.scene.times)
    check_disk_space(path, int(total * PIXEL_BYTES * player.camera.width * player.camera.height))
    right = replace(player.stage) if player.scene.viewpoint.eye == "left" else None
    with write_stream_atomically(path, ".h5", remove_partials=False) as stream, h5py.File(stream, "w") as file:
        pictures = file.create_group("pictures")
        stores: dict[str, h5py.Dataset] = {}
        rows, loads = [], []  # a frame itself holds seven megabytes
        for frame in progress(player.play_frames(together=1 if recording.with_times else BATCH_FRAMES)):
            for name, code in encode_frame(frame, player, recording, right).items():
                if name not in stores:
                    stores[name] = pictures.create_dataset(name, (total,), h5py.vlen_dtype(np.uint8))
                stores[name][frame.number] = code
            if stream.failure is not None:  # no frame after the failure would be kept
                raise stream.failure
            rows.append(collect_frame_values(frame, player, recording.with_times))
            loads.append(frame.loads)
        every = recording.solved_every
        numbers = np.arange(0, total, every or 1)
        asked = [loads[k] for k in numbers]
        truth = None if every is None else solve_reference_frames(theatre, player.scene, asked, solved, recording.fem)
        outcomes = write_motions(file, player, rows, numbers, truth, recording)
        write_attributes(file, theatre, player, deformer, recording)
        write_checksums(file)
    return {"out": str(path), "scene": player.scene.name, "deformer": deformer, "frames": total, "fem": outcomes}


def encode_frame(
    frame: Frame, player: Player, recording: EpisodeRecording, right: Stage | None
) -> dict[str, np.ndarray]:
    """Encode the images of a frame, by name; `right` renders the image of the right eye (None: no stereo)."""
    picture = frame.picture
    tumour = player.stage.select_stage(frame.loads).build_tumour(player.estimate_positions(frame))
    mask = compute_silhouette(frame.camera, tumour.vertices, tumour.triangles, player.stage.device)
    depth = np.minimum(np.rint(picture.depth / DEPTH_SCALE), np.iinfo(np.uint16).max).astype(np.uint16)
    found = {"colour": _encode_jpeg(recording.add_noise(2 * frame.number, picture.colour))}
    if recording.overlay:
        found["overlay"] = _encode_jpeg(frame.shown)
    if right is not None:
        seen = right.select_stage(frame.loads).render(
            _build_right_camera(player, frame), player.compute_positions(frame.deformation), frame.pose
        )
        found["colour_right"] = _encode_jpeg(recording.add_noise(2 * frame.number + 1, seen.colour))
    return found | {
        "depth": encode_png(depth),
        "segmentation": encode_png(picture.segmentation),
        "tumour_mask": encode_png(mask.astype(np.uint8)),
    }


def _encode_jpeg(colour: np.ndarray) -> np.ndarray:
    read = cv2.cvtColor(colour, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", read, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].ravel()


def _build_right_camera(player: Player, frame: Frame) -> Camera:
    """Return the camera of the right eye in a frame."""
    return replace(player.scene.viewpoint, eye="right").build_camera(player.site, frame.time)


def collect_frame_values(frame: Frame, player: Player, with_times: bool = True) -> dict[str, np.ndarray | float | str]:
    """Return all values of a frame except images, by name; computing times are included if `with_times`."""
    nodes, cortex = player.site.anatomy.tumour_nodes, find_cortex_vertices(player)
    right = player.scene.viewpoint.eye == "left"
    return {
        "time": frame.time,
        "T_camera_world": frame.camera.T_camera_world,
        **({} if player.scene.viewpoint.path is None else {"K_of_frame": frame.camera.K}),
        **({} if frame.pose is None or frame.tip is None else collect_tool(frame, frame.pose, frame.tip)),
        **collect_causes(frame.loads),
        **(collect_reactions(frame.deformation) if player.scene.posed else {}),
        "tumour_predicted": player.estimate_positions(frame)[nodes],
        "cortex_predicted": player.compute_positions(frame.deformation)[cortex],
        **({"T_camera_world_right": _build_right_camera(player, frame).T_camera_world} if right else {}),
        "tumour_left": ~player.stage.select_stage(frame.loads).anatomy.orphaned[nodes],
        "outcome_predicted": frame.deformation.outcome[0].name,
        "bound": frame.deformation.bound[:, 0],
        "model_error": to_nan(frame.model_error),
        "tumour_error": to_nan(frame.tumour_error.bound),
        "tumour_error_unobserved": to_nan(frame.tumour_error.prior),
        **({"seconds": np.array([frame.seconds[stage] for stage in STAGES])} if with_times else {}),
    }


def find_cortex_vertices(player: Player) -> np.ndarray:
    """Return the mesh vertices (c,) of the open cortex."""
    return np.unique(player.site.anatomy.open_surface)


def collect_tool(frame: Frame, pose: np.ndarray, tip: np.ndarray) -> dict[str, np.ndarray | float]:
    """Return the tool's pose and tip, and the displayed distance to the tumour with its error, NaN if not available."""
    return {
        "T_world_tool": pose,
        "tip": tip,
        "distance": to_nan(frame.distance),
        "distance_error": to_nan(frame.distance_error),
    }


def collect_reactions(result: Deformation) -> dict[str, np.ndarray]:
    """Return the predicted force of a tool with prescribed pose and its bounds; empty without a prediction."""
    if not result.reaction.shape[1]:
        return {}
    return {"reaction_predicted": result.reaction[0], "reaction_bound": result.reaction_bound[:, 0]}


def to_nan(value: float | None) -> float:
    """Convert None to NaN."""
    return np.nan if value is None else value


def collect_causes(loads: Loads) -> dict[str, np.ndarray]:
    """Return the values of all loads of one load case, by name."""
    found: dict[str, np.ndarray] = {}
    for cause in loads.causes:
        match cause:
            case Pushed() if "force" in found:
                raise InputError("episodes hold the force of one tool: collect a scene of one that pushes.")
            case Pushed():
                found |= {"force": cause.force[0], "contact": cause.point[0]}
            case Posture() | Resected() | Retracted():
                found |= {name: array[0] for name, array in vars(cause).items()}
            case Touching():
                pass  # recorded as T_world_tool
            case _:
                raise InputError(f"episodes hold no {type(cause).__name__}: collect a scene without it.")
    return found


def write_motions(
    file: h5py.File,
    player: Player,
    rows: list[dict],
    frame_numbers: np.ndarray,
    fem: Deformation | None,
    recording: EpisodeRecording,
) -> dict[str, int]:
    """Write all values except images, one row per frame, and the FEM solutions; return their outcomes.

    `fem` has one row for each frame in `frame_numbers` (F,); None: FEM computed the rows themselves.
    """
    nodes, cortex = player.site.anatomy.tumour_nodes, find_cortex_vertices(player)
    rest = player.site.anatomy.mesh.nodes
    columns: dict[str, Sequence | np.ndarray] = {
        name: [row[name] for row in rows] for name in rows[0] if all(name in row for row in rows)
    }
    if fem is None:
        outcomes = list(columns["outcome_predicted"])
        columns |= {f"{of}_fem": columns[f"{of}_predicted"] for of in ("tumour", "cortex")}
    else:
        outcomes = [outcome.name for outcome in fem.outcome]
        for of, which in (("tumour", nodes), ("cortex", cortex)):
            columns[f"{of}_fem"] = rest[which] + fem.restrict(which).displacement
        if fem.reaction.shape[1]:
            columns["reaction_fem"] = fem.reaction
    columns |= {"outcome_fem": outcomes, "fem_frames": frame_numbers, **recording.read_sensors(columns)}
    for name, values in columns.items():
        text = h5py.string_dtype() if isinstance(values[0], str) else None
        made = file.create_dataset(name, data=np.asarray(values, text), compression="gzip")
        made.flush()  # its place in the file is this one, even if a profiler's look at this frame keeps it open
    if "seconds" in file:
        file["seconds"].attrs["stages"] = STAGES
    for of, which in (("tumour", nodes), ("cortex", cortex)):
        file.create_dataset(f"{of}_rest", data=rest[which])
        file.create_dataset(f"{of}_nodes", data=which)
    return {name.lower(): outcomes.count(name) for name in sorted(set(outcomes))}


def write_attributes(
    file: h5py.File, patient: PatientSetup, player: Player, deformer: str, recording: EpisodeRecording
) -> None:
    """Write units, coordinate systems and provenance as attributes."""
    scene, camera, model = player.scene, player.camera, find_model(player.deformer)
    file.create_dataset("K", data=camera.K)
    if camera.lens is not None:
        file.create_dataset("distortion", data=camera.lens.coefficients)
    for name, unit in UNITS.items():
        for place in (name, f"pictures/{name}"):
            if place in file:  # values that no frame has are not written
                file[place].attrs["unit"] = unit
    for name, meaning in MEANINGS.items():
        if name in file:
            file[name].attrs["meaning"] = meaning
    file.attrs.update(
        {
            "format": FORMAT,
            "scene": scene.name,
            "deformer": deformer,
            "effects": repr(scene.get_effects_on(player.site.anatomy)),
            "finite_elements": patient.describe_deformer("fem", scene),
            "answered_by": patient.describe_deformer(deformer, scene),
            "element": patient.choose_element(scene),
            "tissue": "none",
            **describe_tissue_source(scene.elasticity),
            "tool": repr(scene.tool),
            "footprint_m": np.nan if scene.tool is None else scene.tool.radius,
            "model_digest": "none" if model is None else compute_model_digest(model),
            **({"date": datetime.now(UTC).isoformat(timespec="seconds")} if recording.with_times else {}),
            "anatomy": player.site.anatomy.digest,
            "world_frame": "RAS [m]",
            "camera_frame": "OpenCV: x right, y down, z forward; pixel centres at whole numbers",
            "width": camera.width,
            "height": camera.height,
            "depth_scale_m": DEPTH_SCALE,
            "segmentation": ", ".join(f"{label} {name}" for label, name in NAMES.items()) + ", 0 nothing",
            "sulcus_version": get_version("sulcus"),
            "solved_every": recording.solved_every or 1,
            **recording.attributes,
        }
    )


@lru_cache(maxsize=4)
def compute_model_digest(model: Learned) -> str:
    """Compute sixteen hexadecimal digits from a model's parts and its training metadata."""
    found = sha256(repr(sorted(model.training.items())).encode())
    for part in model.parts:
        for array in (part.basis.nodes, part.basis.modes, *part.regressor.state().values()):
            found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()[:16]
