"""Error budget of an overlay on a tracked camera, by source of error, from a Monte Carlo simulation."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from ar.optics.calibration import Calibration
from ar.optics.camera import Camera
from ar.tracking.pose import find_pose
from ar.tracking.registration import Registration
from ar.tracking.targets import build_patient_reference
from sim.errors import InputError
from surrogate.locating.calibration import RADIUS_SQUARED

from ..script.craniotomy_frame import CraniotomyFrame
from ..script.priors import MESH, REGISTRATION, REGISTRATION_PRIOR, SEGMENTATION, SEGMENTATION_PRIOR
from ..script.uncertainty import LEVEL, SURROGATE
from ..script.viewpoint import Viewpoint
from .tracking_errors import CORNER_NOISE, change_calibration, compute_row_delay, project_corners, project_with_shutter
from .uncertainty import SurfaceMotions, compute_motion_errors

# Names of contributors to the overlay error.
CALIBRATION, MARKERS, LATENCY, SHUTTER = "calibration", "markers", "latency x motion", "rolling shutter"
PARAMETERS = "tissue, skull, tool's place"  # Name of the contributor of unknown tissue, skull and tool position.
TECHNICAL = (CALIBRATION, MARKERS, LATENCY, SHUTTER, SURROGATE, MESH)
"""Contributors to the error that belong to the technical system."""
CLINICAL = (*TECHNICAL, REGISTRATION, SEGMENTATION, PARAMETERS)
"""All contributors, including unmeasured properties of the patient."""
CALIBRATION_COUNT = 100  # Number of sampled calibrations.


@dataclass(frozen=True, eq=False)
class FilmedScene:
    """Scene at one time, recorded by a tracked camera, with the sources of error.

    Parameters
    ----------
    site, viewpoint
        Craniotomy, and camera with its calibration and path.
    duration
        Duration of the scene [s]; times on the camera's path are sampled from 0 to `duration`.
    T_scan_patient
        Pose (4, 4) [m] of the patient's reference in the scan.
    covariance
        Covariance (9, 9) of the camera's calibration.
    time
        Time of the scene [s] at which errors are computed.
    rest, field, normals
        Undeformed tumour surface, its displacement, and outward normals of the deformed surface, (n, 3) [m].
    velocity
        Velocity (n, 3) [m/s] of the surface.
    bodies
        Displacements (b, n, 3) [m] of the surface for sampled parameters of tissue, skull and tool.
    meshes, own_mesh
        Discretisation errors (b,) relative to the motion: of each sampled body, and samples for the scene itself.
    surrogate
        Error bound [m] reported by a trained model; 0 for FEM.
    registration
        Measured registration; None: registration shifts have the published standard deviation.
    corner, latency, clock
        Standard deviation of corner positions [pixel]; time [s] from the tracked image to the displayed image; and
        standard deviation of the times of images relative to poses [s].
    """

    site: CraniotomyFrame
    viewpoint: Viewpoint
    duration: float
    T_scan_patient: np.ndarray
    covariance: np.ndarray
    time: float
    rest: np.ndarray
    field: np.ndarray
    normals: np.ndarray
    velocity: np.ndarray
    bodies: np.ndarray
    meshes: np.ndarray
    own_mesh: np.ndarray
    surrogate: float = 0.0
    registration: Registration | None = None
    corner: float = CORNER_NOISE
    latency: float = 0.0
    clock: float = 5e-3

    @cached_property
    def calibration(self) -> Calibration:
        """Calibration of the camera.

        Raises
        ------
        InputError
            The viewpoint has no calibration.
        """
        if self.viewpoint.calibration is None:
            raise InputError("a camera that is tracked has a calibration: give the viewpoint one.")
        return self.viewpoint.calibration

    @cached_property
    def sampled_calibrations(self) -> tuple[Calibration, ...]:
        """Sampled calibrations with errors, cached because building a calibration takes long."""
        scale = np.sqrt(np.diag(self.covariance))
        scale[scale == 0.0] = 1.0  # exact inputs
        values, vectors = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        steps = np.random.default_rng(0).standard_normal((CALIBRATION_COUNT, 9)) * np.sqrt(values.clip(0.0))
        return tuple(change_calibration(self.calibration, step) for step in scale * (steps @ vectors.T))

    @cached_property
    def differences(self) -> np.ndarray:
        """Differences (b, n, 3) [m] between the displacements of the bodies and of the scene, without mesh errors."""
        return self.bodies - self.field


@dataclass(frozen=True, eq=False)
class OverlayErrors:
    """Errors of an overlay in S samples.

    Parameters
    ----------
    across, along, pixels
        Errors (S,) of the tumour's centre across and along the line of sight [m], and in the image [pixel].
    worst
        Maximum surface error (S,) [m], in all directions.
    """

    across: np.ndarray
    along: np.ndarray
    pixels: np.ndarray
    worst: np.ndarray

    @property
    def middle(self) -> np.ndarray:
        """Total error (S,) [m] of the tumour's centre."""
        return np.hypot(self.across, self.along)


def sample_errors(scene: FilmedScene, contributors: Sequence[str], count: int, seed: int = 0) -> OverlayErrors:
    """Sample the overlay error that the `contributors` cause, with all other contributors exact.

    With the same seed, each contributor has the same random numbers in any set of contributors.

    Raises
    ------
    InputError
        The camera does not see the patient's reference.
    """
    rows = [_compare_tumours(*sample) for sample in _generate_samples(scene, frozenset(contributors), count, seed)]
    return OverlayErrors(*np.array(rows).T)


def _generate_samples(
    filmed: FilmedScene, contributors: frozenset[str], count: int, seed: int
) -> Iterator[tuple[Camera, Camera, np.ndarray, np.ndarray]]:
    """Yield for each sample the true and the estimated camera, and the true and the drawn tumour surface (n, 3) [m]."""
    target = build_patient_reference()
    corners = sum(len(face.corners) for face in target.faces)

    def mask_error(name: str, value: np.ndarray) -> np.ndarray:
        return value if name in contributors else np.zeros_like(value)

    for number in range(count):
        random, time, body = _sample_time_and_body(filmed, seed, number)
        late = float(mask_error(LATENCY, np.array(filmed.latency + filmed.clock * random.standard_normal())))
        drawn = int(random.integers(CALIBRATION_COUNT))
        taken = filmed.sampled_calibrations[drawn] if CALIBRATION in contributors else filmed.calibration
        off = mask_error(MARKERS, filmed.corner * random.standard_normal((corners, 2)))
        aside = mask_error(SURROGATE, filmed.surrogate / np.sqrt(RADIUS_SQUARED) * random.standard_normal(3))
        shift = mask_error(REGISTRATION, _sample_registration_error(filmed, random.standard_normal(6)))
        wide = mask_error(SEGMENTATION, SEGMENTATION_PRIOR.range[1] * random.standard_normal(1))
        mesh = mask_error(MESH, (filmed.meshes if PARAMETERS in contributors else filmed.own_mesh)[body])
        readout = filmed.calibration.readout if SHUTTER in contributors else 0.0
        motion = filmed.field + (filmed.differences[body] if PARAMETERS in contributors else 0.0)
        surface = filmed.rest + (1.0 + mesh) * motion
        true, then = _build_cameras(filmed, time, late, readout, surface.mean(axis=0))
        believed = taken.build_camera(then.T_camera_world)
        if taken is not filmed.calibration or off.any() or readout:
            found = project_corners(then, target, filmed.T_scan_patient, off)
            if readout:
                at = partial(_build_delayed_camera, filmed, time - late)
                found = project_with_shutter(found, at, readout, filmed.T_scan_patient)
            initial = then.T_camera_world @ filmed.T_scan_patient
            _, pose = find_pose(believed, target, found, initial)
            if pose is None:
                raise InputError("the camera does not see the patient's reference: take a path that keeps it in sight.")
            believed = taken.build_camera(pose.T_camera_target @ np.linalg.inv(filmed.T_scan_patient))
        shown = filmed.rest + filmed.field - late * filmed.velocity + aside + wide * filmed.normals
        yield true, believed, surface, shown + _compute_registration_shift(filmed, shift, shown)


def _sample_time_and_body(filmed: FilmedScene, seed: int, number: int) -> tuple[np.random.Generator, float, int]:
    """Return a sample's random generator, and the time [s] and the body index that were drawn first from it."""
    random = np.random.default_rng([seed, number])
    return random, random.uniform(0.0, filmed.duration), int(random.integers(len(filmed.bodies)))


def _build_cameras(
    filmed: FilmedScene, time: float, delay: float, readout: float, point: np.ndarray
) -> tuple[Camera, Camera]:
    """Return the true camera of the image row that shows `point` (3,) [m] at a time [s], and the tracked camera."""
    true = _build_delayed_camera(filmed, time, 0.0)
    then = _build_delayed_camera(filmed, time, -delay) if delay else true
    if readout:
        row = float(true.project(point[None])[0][0, 1])
        true = _build_delayed_camera(filmed, time, readout * compute_row_delay(true, row))
    return true, then


def _build_delayed_camera(filmed: FilmedScene, time: float, seconds: float) -> Camera:
    """Return the true camera `seconds` after a time [s]."""
    return filmed.viewpoint.build_camera(filmed.site, time + seconds)


def _sample_registration_error(filmed: FilmedScene, numbers: np.ndarray) -> np.ndarray:
    """Convert 6 normal random numbers to a registration error (6,): translation [m], rotation [rad], reference axes."""
    if filmed.registration is None:
        return np.append(REGISTRATION_PRIOR.range[1] * numbers[:3], np.zeros(3))
    scale = np.repeat([1.0, 0.1], 3)  # so that metres and radians are alike
    root = np.linalg.cholesky(filmed.registration.covariance / np.outer(scale, scale) + 1e-18 * np.eye(6))
    return scale * (root @ numbers)


def _compute_registration_shift(filmed: FilmedScene, error: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the displacement (n, 3) [m] of scan points (n, 3) [m] by a registration error (6,)."""
    if filmed.registration is None:
        return np.broadcast_to(error[:3], points.shape)
    R = filmed.T_scan_patient[:3, :3]
    shift, turn = R @ error[:3], Rotation.from_rotvec(R @ error[3:])
    arm = points - filmed.registration.centre
    return turn.apply(arm) - arm + shift


def _compare_tumours(
    true: Camera, estimated: Camera, surface: np.ndarray, drawn_surface: np.ndarray
) -> tuple[float, float, float, float]:
    """Return errors of the drawn tumour: centre across [m], along [m], in the image [pixel]; maximum on surface [m]."""
    here, there = (np.vstack([points.mean(axis=0), points]) for points in (surface, drawn_surface))
    pixels, depth = true.project(here)
    drawn, farther = estimated.project(there)
    away = np.linalg.norm(drawn - pixels, axis=1)
    # One pixel at the depth of the place: across the line of sight.
    across = away * depth / np.sqrt(true.K[0, 0] * true.K[1, 1])
    along = farther - depth
    worst = float(np.hypot(across, along)[1:].max())
    return float(across[0]), float(along[0]), float(away[0]), worst


@dataclass(frozen=True, eq=False)
class ErrorBudget:
    """Error budget of an overlay: errors of each contributor alone, of all in `TECHNICAL`, and of all in `CLINICAL`.

    `coverage` of the band on synthetic test cases, and its standard deviation (None for one body), in which the
    correlation of samples of the same body is included.
    """

    alone: dict[str, OverlayErrors]
    technical: OverlayErrors
    clinical: OverlayErrors
    coverage: tuple[float, float | None] | None = None

    @property
    def band(self) -> float:
        """95th percentile of the maximum surface error [m]."""
        return float(np.quantile(self.clinical.worst, LEVEL))

    def find_largest(self, error: Literal["middle", "worst"]) -> str:
        """Return the contributor with the largest 95th percentile of the centre's or the maximum surface error."""
        return max(self.alone, key=lambda name: float(np.quantile(getattr(self.alone[name], error), LEVEL)))


def compute_budget(
    scene: FilmedScene,
    count: int,
    seed: int = 0,
    test_scene: FilmedScene | None = None,
    progress: Callable[[Sequence[str]], Iterable[str]] = iter,
) -> ErrorBudget:
    """Compute the budget from `count` samples; the band's coverage is tested on the other bodies of `test_scene`."""
    alone = {name: sample_errors(scene, [name], count, seed) for name in progress(CLINICAL)}
    technical, clinical = (sample_errors(scene, names, count, seed) for names in (TECHNICAL, CLINICAL))
    budget = ErrorBudget(alone, technical, clinical)
    if test_scene is None:
        return budget
    within = sample_errors(test_scene, CLINICAL, count, seed + 1).worst <= budget.band
    return replace(
        budget,
        coverage=_mean(within, [_sample_time_and_body(test_scene, seed + 1, number)[2] for number in range(count)]),
    )


def _mean(mask: np.ndarray, body_numbers: Sequence[int]) -> tuple[float, float | None]:
    """Return the share of True samples (S,), and its standard deviation with `body_numbers` (S,) as clusters.

    Ratio estimator: Cochran (1977), "Sampling techniques", equation 2.46.
    """
    share, numbers = float(mask.mean()), np.unique(body_numbers, return_inverse=True)[1]
    excess = np.bincount(numbers, weights=mask - share)
    clusters = len(excess)
    if clusters < 2:
        return share, None
    return share, float(np.sqrt(np.square(excess).sum() * clusters / (clusters - 1))) / len(mask)


def find_largest_spread(
    nominal_motions: SurfaceMotions, solutions: Sequence[tuple[np.ndarray, ...]], mesh_errors: np.ndarray
) -> int:
    """Return the time index at which sampled bodies differ most; `mesh_errors` (b,): see `compute_motion_errors`."""
    sizes = []
    for number, here in enumerate(nominal_motions.fields):
        off = compute_motion_errors(np.stack([result[number] for result in solutions]), here, mesh_errors)
        sizes.append(float(np.linalg.norm(off, axis=2).max(axis=1).mean()))
    return int(np.argmax(sizes))


def compute_velocity(nominal_motions: SurfaceMotions, time_index: int) -> np.ndarray:
    """Return the tumour surface's velocity (n, 3) [m/s] just before a time; 0 if tissue was resected in between."""
    before, here = nominal_motions.fields[max(time_index - 1, 0)], nominal_motions.fields[time_index]
    if time_index == 0 or before.shape != here.shape:
        return np.zeros_like(here)
    return (here - before) / (nominal_motions.times[time_index] - nominal_motions.times[time_index - 1])
