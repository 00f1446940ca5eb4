"""Registration of the scan to the patient's reference from point pairs and surface points, with covariance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.stats import chi2, f

from .rigid import build_cross_matrices, move_rigidly

MIN_PAIRS = 3  # Minimum number of pairs of points.
LEVEL = 0.95  # Confidence level of the registration's error.

Nearest = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function from scan points (n, 3) [m] to closest surface points (n, 3) [m] and their unit normals (n, 3)."""


@dataclass(frozen=True)
class RegistrationSettings:
    """Settings of `register_points`, `refine_registration` and `compute_pair_residuals`."""

    min_surface_points: int = 20  # Minimum number of points on the surface.
    min_rms: float = 0.1e-3  # Lower bound of rms residuals in ratios [m]: the error of a touched point.
    max_rms: float = 5e-3  # Largest rms residual of pairs and of surface points [m].
    # Smallest ratio of the second to the largest spread of points; below it, the points are on a line.
    min_spread_ratio: float = 0.05
    max_size_log_ratio: float = 0.1  # Largest absolute log-ratio of the sizes of two point sets.
    min_spread: float = 5e-3  # Smallest spread of points on a head [m].
    # Ratio of residuals above which one wrong pair, a swap or a mirrored coordinate system is reported.
    min_residual_ratio: float = 4.0
    max_iterations: int = 50  # Maximum number of Gauss-Newton iterations on a surface.
    step_tolerance: float = 1e-9  # Step below which the iterations on a surface end [m], [rad].


@dataclass(frozen=True, eq=False)
class RegisteredScan:
    """Scan for which a registration was computed.

    Parameters
    ----------
    digest
        Digest of the scan's anatomy.
    bounds
        Smallest and largest coordinates (2, 3) [m] of the anatomy's surface in the scan.
    target
        Centre (3,) [m] of the displayed target.
    """

    digest: str
    bounds: np.ndarray
    target: np.ndarray

    def compute_distance(self, other: RegisteredScan) -> float:
        """Compute the largest distance [m] between bounds or targets of two scans."""
        return float(max(np.abs(self.bounds - other.bounds).max(), np.linalg.norm(self.target - other.target)))


@dataclass(frozen=True, eq=False)
class Registration:
    """Pose of the scan in the frame of the patient's reference, with its error.

    Parameters
    ----------
    T_patient_scan
        Transform (4, 4) [m] from positions in the scan, RAS, to the frame of the reference.
    covariance
        Covariance (6, 6) of translation [m] and rotation [rad] about `centre`, both in the axes of the reference's
        frame. It is widened for few points, so that the 95 % ellipsoid by chi^2 has its nominal coverage.
    centre
        Centroid (3,) [m] of the scan's points.
    rms
        Root mean square residual distance [m] of the point pairs.
    pair_count, surface_count
        Number of point pairs, and number of surface points.
    scan
        Scan for which the registration was computed; None if not known.
    """

    T_patient_scan: np.ndarray
    covariance: np.ndarray
    centre: np.ndarray
    rms: float
    pair_count: int
    surface_count: int = 0
    scan: RegisteredScan | None = None

    def transform_point(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Transform a scan position (3,) [m] to the reference's frame; return it and its covariance (3, 3) [m^2]."""
        T = self.T_patient_scan
        slope = np.hstack([np.eye(3), -build_cross_matrices(T[:3, :3] @ (point - self.centre))])
        return T[:3, :3] @ point + T[:3, 3], slope @ self.covariance @ slope.T


def register_points(
    scan_points: np.ndarray, patient_points: np.ndarray, settings: RegistrationSettings = RegistrationSettings()
) -> Registration:
    """Fit the rigid motion from scan points (n, 3) [m] to the same points (n, 3) [m] in the reference's frame.

    Least squares (Horn 1987, "Closed-form solution of absolute orientation using unit quaternions", J. Opt. Soc. Am. A
    4:629-642). The covariance is that of the linearised problem, as in Fitzpatrick, West, Maurer (1998), "Predicting
    error in rigid-body point-based registration", IEEE Trans. Med. Imaging 17:694-702.

    Raises
    ------
    ValueError
        There are fewer than three pairs, points are on a line, or the two sets differ in size; one set is mirrored, two
        pairs are swapped, one pair fits far worse than the others, or the pairs fit no rigid motion.
    """
    _check_shape(scan_points, patient_points, settings)
    T, off = fit_rigid(scan_points, patient_points)
    _check_fit(scan_points, patient_points, off, settings)
    centre = scan_points.mean(axis=0)
    freedom = 3 * len(scan_points) - 6
    J = compute_jacobian(T, scan_points, centre) / _compute_scatter(off, freedom, settings)
    return Registration(T, _compute_wide_covariance(J.T @ J, freedom), centre, _compute_rms(off), len(scan_points))


def refine_registration(
    scan_points: np.ndarray, patient_points: np.ndarray, surface_points: np.ndarray, find_nearest: Nearest,
    settings: RegistrationSettings = RegistrationSettings(),
) -> Registration:  # fmt: skip
    """Fit as `register_points`, with additional `surface_points` (m, 3) [m] in the reference's frame.

    Residuals of pairs, and distances from tangent planes of the surface (Chen, Medioni 1992, "Object modelling by
    registration of multiple range images"), are weighted by their scatter. Surface motion after the scan causes bias.

    Raises
    ------
    ValueError
        See `register_points`; there are too few surface points, or their root mean square distance from the surface
        remains above 5 mm.
    """
    if len(surface_points) < settings.min_surface_points:
        raise ValueError(
            f"{len(surface_points)} points of the surface are too few: trace {settings.min_surface_points} or more."
        )
    start = register_points(scan_points, patient_points, settings)
    T, centre = start.T_patient_scan, start.centre
    freedom = 3 * len(scan_points) - 6
    touched = _compute_scatter(scan_points @ T[:3, :3].T + T[:3, 3] - patient_points, freedom, settings)
    normal, off, away = np.eye(6), np.zeros((1, 3)), np.zeros(1)
    for _ in range(settings.max_iterations):
        off = scan_points @ T[:3, :3].T + T[:3, 3] - patient_points
        place, outward = find_nearest((surface_points - T[:3, 3]) @ T[:3, :3])
        turned = outward @ T[:3, :3].T
        away = np.einsum("ni,ni->n", turned, place @ T[:3, :3].T + T[:3, 3] - surface_points)
        traced = _compute_scatter(away, len(surface_points), settings)
        J = compute_jacobian(T, scan_points, centre) / touched
        K = np.einsum("ni,nij->nj", turned, compute_jacobian(T, place, centre).reshape(-1, 3, 6)) / traced
        normal = J.T @ J + K.T @ K
        step = -np.linalg.solve(normal, J.T @ off.ravel() / touched + K.T @ away / traced)
        T = move_rigidly(T, centre, step)
        if np.abs(step).max() < settings.step_tolerance:
            break
    if not max(_compute_rms(off), _compute_rms(away[:, None])) <= settings.max_rms:
        raise ValueError(
            f"the points stay {1e3 * _compute_rms(away[:, None]):.1f} mm (rms) from the surface, and the pairs "
            f"{1e3 * _compute_rms(off):.1f} mm: trace the surface that the scan shows, before it moves."
        )
    return Registration(
        T,
        _compute_wide_covariance(normal, freedom + len(surface_points)),
        centre,
        _compute_rms(off),
        len(scan_points),
        len(surface_points),
    )


def _check_shape(scan_points: np.ndarray, patient_points: np.ndarray, settings: RegistrationSettings) -> None:
    """Raise ValueError if the point sets do not determine a rigid motion."""
    if len(scan_points) < MIN_PAIRS:
        raise ValueError(f"{len(scan_points)} pairs are too few: touch {MIN_PAIRS} points or more, better six.")
    sizes = [np.linalg.svd(points - points.mean(axis=0), compute_uv=False) for points in (scan_points, patient_points)]
    for what, size in zip(("scan", "patient"), sizes, strict=True):
        if not size[1] > settings.min_spread_ratio * size[0]:
            raise ValueError(f"the points of the {what} lie on a line: choose some that lie apart from it.")
    if not sizes[0][0] > settings.min_spread:
        raise ValueError(f"the points lie within {2e3 * sizes[0][0]:.2g} mm of each other: give millimetres.")
    ratio = float(np.linalg.norm(sizes[1]) / np.linalg.norm(sizes[0]))
    if abs(np.log(ratio)) > settings.max_size_log_ratio:
        raise ValueError(
            f"the patient's points are {ratio:.3g} times as far apart as the scan's: give both in millimetres."
        )


def _check_fit(scan: np.ndarray, patient: np.ndarray, residuals: np.ndarray, settings: RegistrationSettings) -> None:
    """Raise ValueError for a mirrored set, a single wrong pair, two swapped pairs, or pairs that do not fit."""
    rms = _compute_rms(residuals)
    mirrored = _compute_rms(fit_rigid(scan * [-1.0, 1.0, 1.0], patient)[1])
    if settings.min_residual_ratio * max(mirrored, settings.min_rms) < rms:
        raise ValueError("the scan's points fit their mirror image only: one frame is left-handed. Give RAS.")
    if len(scan) > MIN_PAIRS + 1:
        remaining = [[np.delete(points, row, axis=0) for points in (scan, patient)] for row in range(len(scan))]
        others = [_compute_rms(fit_rigid(*pairs)[1]) for pairs in remaining]
        row, swaps = int(np.argmin(others)), _compute_swapped_rms(scan, patient)
        one, other = min(swaps, key=lambda pair: swaps[pair])
        if (
            rms > settings.max_rms / 2
            and settings.min_residual_ratio * max(swaps[one, other], settings.min_rms) < rms
            and swaps[one, other] < others[row]
        ):
            raise ValueError(
                f"pairs {one + 1} and {other + 1} (below the header) are swapped: the other way round all fit to "
                f"{1e3 * swaps[one, other]:.1f} mm. Exchange their px,py,pz."
            )
        if rms > settings.max_rms / 2 and settings.min_residual_ratio * max(others[row], settings.min_rms) < rms:
            raise ValueError(
                f"pair {row + 1} (below the header) fits worse than the others (error {1e3 * others[row]:.1f} mm "
                "without it): touch it again, or leave it out."
            )
    if not rms <= settings.max_rms:
        raise ValueError(
            f"the pairs stay {1e3 * rms:.1f} mm apart (rms), and up to {1e3 * settings.max_rms:.0f} are taken: see "
            "whether each row names the same place twice."
        )


def _compute_swapped_rms(scan_points: np.ndarray, patient_points: np.ndarray) -> dict[tuple[int, int], float]:
    """Compute rms residuals [m] after swapping the patient's points of two pairs; return each by the pairs' indices."""
    out = {}
    for pair in combinations(range(len(scan_points)), 2):
        other = patient_points.copy()
        other[list(pair)] = patient_points[list(pair[::-1])]
        out[pair] = _compute_rms(fit_rigid(scan_points, other)[1])
    return out


def fit_rigid(scan_points: np.ndarray, patient_points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit T_patient_scan (4, 4) to n point pairs (Kabsch 1976); return the transform and the residuals (n, 3) [m]."""
    middle, there = scan_points.mean(axis=0), patient_points.mean(axis=0)
    T = np.eye(4)
    u, _, v = np.linalg.svd((patient_points - there).T @ (scan_points - middle))
    T[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    T[:3, 3] = there - T[:3, :3] @ middle
    return T, scan_points @ T[:3, :3].T + T[:3, 3] - patient_points


def compute_jacobian(T: np.ndarray, points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Compute the Jacobian (3 n, 6) of transformed points (n, 3) by translation and rotation about `centre`."""
    arms = (points - centre) @ T[:3, :3].T
    return np.concatenate(
        [np.broadcast_to(np.eye(3), (len(points), 3, 3)), -build_cross_matrices(arms)], axis=2
    ).reshape(-1, 6)


def _compute_wide_covariance(normal_matrix: np.ndarray, dof: int) -> np.ndarray:
    """Invert a normal matrix to a covariance (6, 6), widened as its scatter has few degrees of freedom (`dof`)."""
    inverse = 3.0 * f.ppf(LEVEL, 3, dof) / chi2.ppf(LEVEL, 3) * np.linalg.inv(normal_matrix)
    return 0.5 * (inverse + inverse.T)


def _compute_scatter(residuals: np.ndarray, dof: int, settings: RegistrationSettings) -> float:
    """Estimate the standard deviation [m] of residuals along an axis, at least `RegistrationSettings.min_rms`."""
    return max(float(np.sqrt((residuals**2).sum() / dof)), settings.min_rms)


def _compute_rms(residuals: np.ndarray) -> float:
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


FALSE_ALARM_RATE = 0.05  # Share of valid point sets in which a pair is reported as an outlier.


@dataclass(frozen=True, eq=False)
class PairResiduals:
    """Residuals of n point pairs, to find an outlier.

    Parameters
    ----------
    residuals
        Residual distances (n,) [m] in the registration with all pairs.
    held_out
        Residual distance (n,) [m] of each pair in the registration without this pair.
    studentised
        `held_out` (n,) over its standard deviation, predicted from the other pairs' scatter; NaN for three pairs, from
        which scatter cannot be estimated.
    p_value
        Probability that a set without outliers has a largest residual at least this large; NaN for three pairs.
    """

    residuals: np.ndarray
    held_out: np.ndarray
    studentised: np.ndarray
    p_value: float

    @property
    def worst_pair(self) -> int:
        """Index of the pair that fits worst to the other pairs."""
        return int(np.argmax(self.held_out if np.isnan(self.studentised).any() else self.studentised))

    @property
    def has_outlier(self) -> bool:
        """True if the worst pair is an outlier, at a false-alarm rate of `FALSE_ALARM_RATE`."""
        return self.p_value < FALSE_ALARM_RATE


def compute_pair_residuals(
    scan_points: np.ndarray, patient_points: np.ndarray, settings: RegistrationSettings = RegistrationSettings()
) -> PairResiduals:
    """Compute the residuals of point pairs (n, 3) [m], in the scan and in the reference's frame.

    The residuals are externally studentised, with three coordinates each (Cook, Weisberg 1982, "Residuals and influence
    in regression"). Their squares are F-distributed with 3 and 3 n - 9 degrees of freedom. The worst pair's p-value has
    a Bonferroni correction.

    Raises
    ------
    ValueError
        See `register_points`.
    """
    found = register_points(scan_points, patient_points, settings)
    T, count = found.T_patient_scan, len(scan_points)
    off = scan_points @ T[:3, :3].T + T[:3, 3] - patient_points
    if count == MIN_PAIRS:
        # Two pairs, the remainder of three, determine no registration.
        none = np.full(count, np.nan)
        return PairResiduals(np.linalg.norm(off, axis=1), none, none, np.nan)
    J = compute_jacobian(T, scan_points, found.centre)
    hat = J @ np.linalg.solve(J.T @ J, J.T)
    freedom = 3 * count - 9
    free = np.stack([np.eye(3) - hat[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(count)])
    held_out = np.linalg.solve(free, off[..., None])[..., 0]
    own = np.einsum("ni,ni->n", off, held_out)
    others = np.maximum((np.square(off).sum() - own) / freedom, settings.min_rms**2)
    squares = own / (3.0 * others)
    chance = min(1.0, count * float(f.sf(squares.max(), 3, freedom)))
    return PairResiduals(np.linalg.norm(off, axis=1), np.linalg.norm(held_out, axis=1), np.sqrt(squares), chance)
