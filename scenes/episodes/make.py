"""Creation of missing episodes and bodies of a data set in a folder."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from shutil import rmtree
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import ndtri

from sim.errors import InputError
from sim.fem import Fem
from sim.resected_fem import ResectedFem
from sim.runtime.atomic_files import write_folder_atomically
from sim.runtime.partial_files import list_partials, to_partial_path

from ..play.deformers import PatientSetup
from ..play.reference import build_reference_fem
from ..script.scene import Scene
from .bodies import BODY_FILE, EpisodeBody, read_body, write_body
from .draws import build_generator
from .episode import EpisodeRecording, collect
from .incomplete_bodies import clear_folder, has_solved_loads
from .plan import NO_LEARNER, EpisodePlan
from .run_folder import BODIES, to_episode_name
from .scripted import build_scene, sample_body_number, sample_episode
from .tasks import MadeEpisode

# 256 equally probable quantiles of the normal distribution [standard deviations].
QUANTILES = ndtri((np.arange(256) + 0.5) / 256)


def add_noise(image: np.ndarray, sigma: float, random: np.random.Generator) -> np.ndarray:
    """Return an image (H, W, 3) uint8 with Gaussian noise of deviation `sigma` [grey levels], independent by pixel.

    The noise has 256 equally probable values, quantiles of the normal distribution, which are fast to sample and fit
    into a byte up to a standard deviation of 40.
    """
    if sigma == 0.0:
        return image
    steps = np.rint(sigma * QUANTILES).astype(np.int8).tobytes()
    added = np.frombuffer(random.bytes(image.size).translate(steps), np.int8).reshape(image.shape)
    total = np.add(image, added, dtype=np.int16)
    return np.clip(total, 0, 255, out=total).astype(np.uint8)


def add_jitter(poses: np.ndarray, position_sigma: float, angle_sigma: float, random: np.random.Generator) -> np.ndarray:
    """Return poses (n, 4, 4) with Gaussian errors along [m] and about [rad] the axes of each pose's own system."""
    off = np.tile(np.eye(4), (len(poses), 1, 1))
    off[:, :3, 3] = position_sigma * random.standard_normal((len(poses), 3))
    off[:, :3, :3] = Rotation.from_rotvec(angle_sigma * random.standard_normal((len(poses), 3))).as_matrix()
    return poses @ off


def add_sensor_noise(
    columns: Mapping[str, Any], noise: Mapping[str, float], seed: int, number: int
) -> dict[str, np.ndarray]:
    """Return the simulated sensor readings of an episode: measured force, and tracked poses of tool and camera."""
    found: dict[str, np.ndarray] = {}
    if "force" in columns:
        force = np.asarray(columns["force"])
        random = build_generator(seed, number, "noise.force")
        found["force_read"] = force + noise["force_n"] * random.standard_normal(force.shape)
    for name, whose in (("T_world_tool", "tool"), ("T_camera_world", "camera")):
        if name in columns:
            random = build_generator(seed, number, f"noise.{whose}")
            shift, turn = 1e-3 * noise[f"{whose}_mm"], float(np.radians(noise[f"{whose}_deg"]))
            found[f"{name}_tracked"] = add_jitter(np.asarray(columns[name]), shift, turn, random)
    return found


MAX_CACHE_SIZE = 2
"""Maximum number of open bodies in a process, and of cached FEM solvers of each body."""
TRANSIENT_ERRORS = OSError, MemoryError
"""Temporary errors, for example of the disk or due to other processes on a GPU, after which a retry may succeed."""


def to_episode_path(folder: Path, number: int) -> Path:
    """Return the path of an episode's file."""
    return folder / to_episode_name(number)


def to_body_path(folder: Path, number: int) -> Path:
    """Return the path of a body's folder."""
    return folder / BODIES / f"{number:04d}"


def choose_body(plan: EpisodePlan, seed: int, number: int) -> int:
    """Return the number of the body of episode `number`."""
    return sample_body_number(plan.contents, seed, number)


def make_body(folder: Path, plan: EpisodePlan, seed: int, number: int, device: str = "auto") -> MadeEpisode:
    """Make a body, unless the body exists; a failure is reported in `MadeEpisode.failed`.

    The folder has a temporary name until it is complete. If another process finishes the same body first, the equal
    copy of this process is discarded. Loads that were already solved are reused.
    """
    path = to_body_path(folder, number)
    if (path / BODY_FILE).is_file():
        return MadeEpisode(path, skipped=True)
    if path.exists() and not (path / BODY_FILE).is_file():  # checked again: another process may have made it meanwhile
        return MadeEpisode(path, failed=f"{path}: is no whole body. Remove it, and give the same command with --again.")
    resumed = False
    try:
        with write_folder_atomically(path, is_kept=has_solved_loads) as partial:
            clear_folder(partial)
            resumed = write_body(partial, plan, seed, number, device, list_partials(path))
    except InputError as error:
        whole = (path / BODY_FILE).is_file()  # another process was faster
        if not whole and isinstance(error.__cause__, TRANSIENT_ERRORS):
            raise
        rmtree(to_partial_path(path), ignore_errors=True)
        if not whole:
            return MadeEpisode(path, failed=str(error))
    size = sum(file.stat().st_size for file in path.iterdir())
    return MadeEpisode(path, bytes=size, resumed=resumed)


def make_episode(folder: Path, plan: EpisodePlan, seed: int, number: int, device: str = "auto") -> MadeEpisode:
    """Make an episode, unless the episode exists; its body must exist. `MadeEpisode.failed` reports a failure.

    A load without equilibrium is no failure: `outcome_predicted` and `outcome_fem` record the outcome of each frame.
    """
    path = to_episode_path(folder, number)
    if path.is_file():
        return MadeEpisode(path, skipped=True)
    try:
        report = _collect_episode(
            path, plan, seed, number, to_body_path(folder, choose_body(plan, seed, number)), device
        )
    except InputError as error:
        if isinstance(error.__cause__, TRANSIENT_ERRORS):
            raise
        return MadeEpisode(path, failed=str(error))
    return MadeEpisode(path, int(str(report["frames"])), path.stat().st_size)


@dataclass(frozen=True, eq=False)
class OpenedBody:
    """Body whose files are loaded, and cached FEM solvers by effects."""

    body: EpisodeBody
    patient: PatientSetup
    solvers: dict[str, Fem | ResectedFem] = field(default_factory=dict)

    def get_fem(self, scene: Scene) -> Fem | ResectedFem:
        """Return the FEM solver of a scene; a few solvers are cached, because building a solver takes long."""
        asked = repr(scene.get_effects_on(self.patient.anatomy))
        if asked not in self.solvers:
            if len(self.solvers) >= MAX_CACHE_SIZE:
                self.solvers.clear()
            self.solvers[asked] = build_reference_fem(self.patient, scene)
        return self.solvers[asked]


@lru_cache(maxsize=MAX_CACHE_SIZE)
def open_body(folder: Path, device: str) -> OpenedBody:
    """Load an existing body; the result is cached for further episodes. Raises InputError, see `read_body`."""
    body = read_body(folder)
    return OpenedBody(body, body.open_patient(device))


def _collect_episode(
    path: Path, plan: EpisodePlan, seed: int, number: int, body_folder: Path, device: str
) -> Mapping[str, Any]:
    """Play an episode on the body in folder `body_folder`, write its file, and return a summary."""
    contents = plan.contents
    opened, asked = open_body(body_folder, device), sample_episode(contents, seed, number)
    body, patient = opened.body, opened.patient
    scene = build_scene(plan, body, patient.site, asked, seed, number)
    name = "fem" if contents.bodies.learner.name == NO_LEARNER else patient.select_best(scene)
    player = replace(patient.build_player(name, scene), composed=contents.overlay)
    noise = asked.group("noise")

    def add_image_noise(frame_number: int, colour: np.ndarray) -> np.ndarray:
        return add_noise(colour, noise["grey_levels"], build_generator(seed, number, f"noise.picture/{frame_number}"))

    recording = EpisodeRecording(
        None if name == "fem" else contents.solved_every, contents.overlay, False, add_image_noise,
        lambda columns: add_sensor_noise(columns, noise, seed, number),
        {
            "plan": plan.text, "plan_name": plan.name, "plan_digest": plan.digest, "seed": seed, "episode": number,
            "family": asked.family, "body": asked.body,
            "parameters": json.dumps({**asked.values, **body.parameters}, sort_keys=True),
        },
        None if name == "fem" else opened.get_fem(scene),
    )  # fmt: skip
    return collect(path, patient, player, name, lambda frames: frames, recording=recording)
