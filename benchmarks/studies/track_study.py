"""Error of a tool's tip tracked by its printed cube: images with known poses, by two published protocols.

FMAC (arXiv 2601.07723) spreads poses evenly over all six degrees of freedom. ASTM F2554 (2022) touches one point
repeatedly, rotates the tool about it, and measures distances between points.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, qmc

from ar.optics.camera import Camera
from ar.optics.lens import Lens
from ar.tracking.pose import Pose, PoseStatus, Tracker
from ar.tracking.synthetic_images import render_targets
from ar.tracking.targets import MARKER_RATIO, TIP_DISTANCE, build_tool_cube

# Camera of the published trials: image size and focal length [pixel], distance of targets [m], and a typical lens.
WIDTH, HEIGHT, FOCAL, AWAY = 1280, 960, 1400.0, 0.4
LENS = Lens(-0.1, 0.02, 5e-4, -3e-4)
# Blur [pixel] and noise [of 255] of the images; side [pixel] below which a marker need not be detected.
BLUR, NOISE, SEEN = 0.5, 2.0, 20.0
# Half sizes of the volume of the cube's positions [m], and maximum rotation [degree].
VOLUME, TURNED = np.array([0.09, 0.06, 0.03]), 45.0
# Half side of the cube of touched points [m], and the tool's maximum rotation there [degree].
TOUCHED, LEANING = 0.03, 30.0


@dataclass(frozen=True)
class TrackRow:
    """Results of one protocol; errors of the tip [mm].

    Parameters
    ----------
    median, p95, most
        Statistics of the protocol's error: distance from the truth, from the mean, or error of distances.
    certain
        Share [%] of images with a certain pose, of those with markers of at least 20 pixels; None without such images.
    wrong
        Number of certain poses with an error above 5 of their standard deviations and 1 mm.
    held
        Empirical coverage of the tip by the 95 % ellipsoid [%].
    milliseconds
        Median time of an image while the target is tracked [ms].
    """

    protocol: str
    pictures: int
    median: float
    p95: float
    most: float
    certain: float | None
    wrong: int
    held: float
    milliseconds: float


@dataclass(frozen=True, eq=False)
class TrackedImage:
    """Image: true tip; tip and covariance of a certain pose; and the computing time."""

    true_tip: np.ndarray
    markers: float
    estimate: np.ndarray | None
    covariance: np.ndarray | None
    seconds: float


def build_trial_camera() -> Camera:
    """Build the camera of the trials, at the world's origin."""
    K = np.array([[FOCAL, 0.0, 0.5 * WIDTH - 20.0], [0.0, FOCAL, 0.5 * HEIGHT + 12.0], [0.0, 0.0, 1.0]])
    return Camera(K, np.eye(4), WIDTH, HEIGHT, LENS)


def measure_protocols(
    count: int, seed: int = 0, progress: Callable[[int, int], object] = lambda done, total: None
) -> list[TrackRow]:
    """Measure all protocols, with `count` images each."""
    plans = {
        "FMAC: all six freedoms": (sample_poses(count, seed), _off),
        "F2554: one point": (build_pivot_poses(count, seed, np.zeros(3)), _from_mean),
        "F2554: between points": (build_pivot_poses(count, seed, None), compute_distance_errors),
    }
    rows, done, total = [], 0, count * len(plans)
    for name, (poses, measure) in plans.items():
        shots = []
        for shot in _shots(poses, seed):
            shots.append(shot)
            done += 1
            progress(done, total)
        rows.append(build_row(name, shots, measure))
    return rows


def build_row(name: str, images: list[TrackedImage], measure: Callable[[list[TrackedImage]], np.ndarray]) -> TrackRow:
    """Build a protocol's row from errors (n,) [m] of its images with certain poses."""
    certain = [shot for shot in images if shot.estimate is not None]
    fair = [shot for shot in images if shot.markers >= SEEN]
    error = 1e3 * measure(certain)
    far = [_in_deviations(shot) for shot in certain]
    off = 1e3 * _off(certain)
    median, p95, most = np.percentile(error, [50, 95, 100]).tolist()
    return TrackRow(
        protocol=name,
        pictures=len(images),
        median=median,
        p95=p95,
        most=most,
        certain=100.0 * float(np.mean([shot.estimate is not None for shot in fair])) if fair else None,
        wrong=int(sum(each > 5.0**2 and here > 1.0 for each, here in zip(far, off, strict=True))),
        held=100.0 * float(np.mean(np.array(far) <= chi2.ppf(0.95, 3))),
        milliseconds=1e3 * float(np.median([shot.seconds for shot in images])),
    )


def _in_deviations(shot: TrackedImage) -> float:
    """Compute the squared Mahalanobis distance of the estimated tip from the true one."""
    assert shot.estimate is not None and shot.covariance is not None
    error = shot.estimate - shot.true_tip
    return float(error @ np.linalg.solve(shot.covariance, error))


def _off(shots: list[TrackedImage]) -> np.ndarray:
    """Compute distances (n,) [m] from the true tips."""
    return np.array([np.linalg.norm(shot.estimate - shot.true_tip) for shot in shots if shot.estimate is not None])


def _from_mean(shots: list[TrackedImage]) -> np.ndarray:
    """Compute distances (n,) [m] of repeated touches from their mean."""
    found = np.array([shot.estimate for shot in shots])
    return np.linalg.norm(found - found.mean(axis=0), axis=1)


def compute_distance_errors(images: list[TrackedImage]) -> np.ndarray:
    """Compute errors (n - 1,) [m] of the distances between successive points."""
    found, true = (np.array([getattr(shot, name) for shot in images]) for name in ("estimate", "true_tip"))
    lengths = [np.linalg.norm(np.diff(each, axis=0), axis=1) for each in (found, true)]
    return np.abs(lengths[0] - lengths[1])


def sample_poses(count: int, seed: int) -> Iterator[np.ndarray]:
    """Yield poses (4, 4) of the cube, uniform over its volume and rotations."""
    for u in _numbers(count, seed):
        axis = _direction(u[0], u[1])
        T = _facing(Rotation.from_rotvec(np.radians(TURNED) * np.cbrt(u[2]) * axis))
        T[:3, 3] = (2.0 * u[3:] - 1.0) * VOLUME + [0.0, 0.0, AWAY]
        yield T


def _numbers(count: int, seed: int) -> np.ndarray:
    """Generate low-discrepancy numbers (count, 6) in [0, 1); the next seed continues the sequence."""
    return qmc.Halton(6, scramble=False).fast_forward(1 + seed * count).random(count)


def build_pivot_poses(count: int, seed: int, point: np.ndarray | None) -> Iterator[np.ndarray]:
    """Yield poses (4, 4) of the cube with the tip on a point (3,) [m] about the volume's centre; None: many points."""
    for u in _numbers(count, seed):
        axis = _direction(u[0], u[1])
        T = _facing(Rotation.from_rotvec(np.radians(LEANING) * np.cbrt(u[2]) * axis))
        tip = (2.0 * u[3:] - 1.0) * TOUCHED if point is None else point
        middle = _facing(Rotation.identity())[:3, :3] @ [0.0, 0.0, -TIP_DISTANCE]
        T[:3, 3] = [0.0, 0.0, AWAY] + middle + tip - T[:3, :3] @ [0.0, 0.0, -TIP_DISTANCE]
        yield T


def _direction(u: float, v: float) -> np.ndarray:
    """Map two numbers in [0, 1) to a unit vector (3,), uniform by area."""
    z = 2.0 * u - 1.0
    ring = np.sqrt(1.0 - z * z)
    return np.array([ring * np.cos(2.0 * np.pi * v), ring * np.sin(2.0 * np.pi * v), z])


def _facing(turn: Rotation) -> np.ndarray:
    """Build a pose (4, 4) of the cube, rotated from the one whose corner between its faces points to the camera."""
    forward = -np.ones(3) / np.sqrt(3.0)
    right = -np.cross([0.0, 0.0, 1.0], forward)
    right = right / np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = turn.as_matrix() @ np.stack([right, np.cross(forward, right), forward])
    return T


def _shots(poses: Iterable[np.ndarray], seed: int) -> Iterator[TrackedImage]:
    camera, cube, rng = build_trial_camera(), build_tool_cube(), np.random.default_rng(seed)
    tracker = Tracker(camera, (cube,))
    for T in poses:
        sharp = render_targets(np.full((HEIGHT, WIDTH), 120, np.uint8), camera, [(cube, T)])
        blurred = gaussian_filter(sharp.astype(np.float32), BLUR)
        picture = np.clip(blurred + rng.normal(0.0, NOISE, blurred.shape), 0.0, 255.0).astype(np.uint8)
        first = tracker.track(picture)
        begun = time.perf_counter()
        again = tracker.track(picture, first)  # as in tracking
        seconds = time.perf_counter() - begun
        tip = np.array([0.0, 0.0, -TIP_DISTANCE])
        pose: Pose | None = again.poses.get(cube.name) if again.statuses[cube.name] is PoseStatus.GOOD else None
        found, covariance = (None, None) if pose is None else pose.transform_point(tip)
        yield TrackedImage(T[:3, :3] @ tip + T[:3, 3], _markers(camera, T), found, covariance, seconds)


def _markers(camera: Camera, T: np.ndarray) -> float:
    """Compute the side [pixel] of the markers on the largest visible face: root of a square's area."""
    sides = [0.0]
    for face in build_tool_cube().faces:
        pixels = camera.project(face.outline @ T[:3, :3].T + T[:3, 3])[0]
        (x, y), (x_next, y_next) = pixels.T, np.roll(pixels, -1, axis=0).T
        area = 0.5 * float(np.sum(x * y_next - x_next * y))  # negative for a face seen from behind
        sides.append(MARKER_RATIO * np.sqrt(max(area, 0.0) / (face.columns * face.rows)))
    return float(max(sides))
