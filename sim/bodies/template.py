"""Synthetic tumour in a healthy head, by default the MNI152 brain of nilearn, scaled to a typical volume."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, cast

import numpy as np
from scipy import ndimage

from ..errors import InputError
from ..runtime.optional_packages import require_extra
from .intensity import Intensity
from .placement import TumourPiece, find_reachable_site
from .signed_distance import Field, compute_level_set
from .subject import Subject, find_boundary_voxels

MNI_CENTRE = (0.0, -17.4, 5.4)
"""Centre of the template's bounding box, the origin of the directions in `SITES` [mm]."""
SITES = {
    "frontal": (32.0, 42.0, 36.0),
    "central": (40.0, -14.0, 58.0),
    "parietal": (36.0, -58.0, 52.0),
    "temporal": (66.0, -22.0, 2.0),
    "occipital": (28.0, -92.0, 14.0),
}
"""Named points that define directions from `MNI_CENTRE` to the right hemisphere: MNI152 coordinates [mm]."""

Shape = Literal["sphere", "lobed"]  # tumour shapes
MIN_RADIUS = 3e-3  # minimum tumour radius [m]
MAX_RADIUS = 35e-3  # maximum tumour radius [m]
MIN_COVER = 1e-3  # minimum depth of the tumour's top under the cortex [m]
MAX_COVER = 60e-3  # maximum depth of the tumour's top under the cortex [m]


@dataclass(frozen=True)
class HeadScaling:
    """Scaling of the template and requirements of a synthetic tumour.

    Parameters
    ----------
    volume
        Volume of the scaled brain [m^3]; the mask has 1,883 ml, more than a typical brain.
    threshold
        Intensity threshold of brain voxels, as a fraction of the maximum intensity; the default is that of nilearn.
    smoothing_length
        Length over which the cortex is averaged to compute its inward normal [m].
    clearance
        Minimum thickness of brain around the tumour [m].
    """

    volume: float = 1470e-6
    threshold: float = 0.2
    smoothing_length: float = 5e-3
    clearance: float = 5e-4


@dataclass(frozen=True)
class Lobes:
    """Shape parameters of a lobed tumour.

    Parameters
    ----------
    count
        Number of lobes, in random directions.
    height
        Maximum height of a lobe, as a fraction of the radius. The minimum height is 0.3 times the maximum.
    sharpness
        Sharpness s of all lobes, see `Lobed`.
    """

    count: int = 6
    height: float = 0.5
    sharpness: float = 5.0


@dataclass(frozen=True)
class Tumour:
    """Size, shape and position of a synthetic tumour.

    Parameters
    ----------
    radius
        Radius of the ball of the same volume [m].
    cover
        Distance from the cortex at the `site`, a name in `SITES`, to the top of the tumour [m].
    shape, lobes
        Shape, "sphere" or "lobed", and parameters of the lobes.
    seed
        Random seed of the lobes' directions and heights.
    middle
        Centre (x, y, z) [m, RAS] of the tumour; replaces `cover` and `site`.

    Raises
    ------
    InputError
        The radius is outside 3 to 35 mm, the cover is outside 1 to 60 mm, the shape or site is unknown, or the centre
        is not finite.
    """

    radius: float = 0.012
    cover: float = 0.010
    shape: Shape = "sphere"
    site: str = "central"
    seed: int = 0
    middle: tuple[float, float, float] | None = None
    lobes: Lobes = Lobes()

    def __post_init__(self) -> None:
        for name, value, low, high in (
            ("radius", self.radius, MIN_RADIUS, MAX_RADIUS),
            ("cover", self.cover, MIN_COVER, MAX_COVER),
        ):
            if not low <= value <= high:
                raise InputError(
                    f"a tumour {name} of {value * 1e3:g} mm is outside {low * 1e3:g} to {high * 1e3:g} mm: choose one "
                    "between."
                )
        if self.shape not in ("sphere", "lobed"):
            raise InputError(f"no tumour shape is called {self.shape!r}: choose sphere or lobed.")
        if self.site not in SITES:
            raise InputError(f"no site is called {self.site!r}: choose one of {', '.join(SITES)}.")
        if self.seed < 0:
            raise InputError(f"a seed of {self.seed} is negative: give 0 or more.")
        if self.middle is not None and not np.isfinite(self.middle).all():
            raise InputError("a tumour's middle needs three finite coordinates.")

    @property
    def place(self) -> str:
        """Description of the tumour position, for messages."""
        if self.middle is not None:
            return f"at {', '.join(f'{1e3 * value:g}' for value in self.middle)} mm"
        return f"with {self.cover * 1e3:g} mm of cover at the {self.site} site"


@dataclass(frozen=True, eq=False)
class HealthyHead:
    """Head without a tumour.

    Parameters
    ----------
    mask, affine
        Brain voxels (I, J, K) bool, and affine (4, 4) from their indices to metres (RAS).
    intensity
        Grey values in the same coordinates, or None.
    origin
        Origin (3,) [m] of the directions in `SITES`; None: the centre of the brain's bounding box.
    notes
        Notes for the user on assumptions.
    """

    mask: np.ndarray
    affine: np.ndarray
    intensity: Intensity | None = None
    origin: tuple[float, float, float] | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Lobed:
    """Star-shaped solid whose radius in unit direction n is scale * (1 + sum_k height_k exp(s (n . d_k - 1))).

    `middle` (3,) [m]; unit `directions` d (L, 3); `heights` (L,); `scale` [m]; `sharpness` s. L = 0 is a ball.
    """

    middle: np.ndarray
    directions: np.ndarray
    heights: np.ndarray
    scale: float
    sharpness: float = Lobes.sharpness

    def compute_radius(self, directions: np.ndarray) -> np.ndarray:
        """Return the distance (n,) [m] from the centre to the surface in unit directions (n, 3)."""
        lobes = np.exp(self.sharpness * (directions @ self.directions.T - 1.0))
        return self.scale * (1.0 + lobes @ self.heights)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distance (n,) [m] of points (n, 3) [m] from the surface along the ray from the centre."""
        arm = points - self.middle
        length = np.linalg.norm(arm, axis=1)
        return length - self.compute_radius(arm / np.maximum(length, 1e-12)[:, None])

    radius = compute_radius  # Former names, for one release.


def build_template_subject(tumour: Tumour, head: HeadScaling = HeadScaling()) -> Subject:
    """Return the template with a tumour, in RAS coordinates of the template, scaled about the centroid of the brain.

    Raises
    ------
    InputError
        The tumour would extend beyond the brain.

    Examples
    --------
    >>> from sim import Tumour, build_template_subject
    >>> subject = build_template_subject(Tumour(radius=0.010, cover=0.012))
    >>> print(f"{1e6 * subject.tumour_volume:.1f} ml in {len(subject.pieces)} piece")
    4.2 ml in 1 piece
    """
    return build_synthetic_subject(tumour, _load_scaled_template(head), head)


def build_synthetic_subject(tumour: Tumour, healthy: HealthyHead, head: HeadScaling = HeadScaling()) -> Subject:
    """Return a healthy head with a synthetic tumour; `volume` and `threshold` of `head` are ignored.

    Raises
    ------
    InputError
        A tumour that would extend beyond the brain.
    """
    brain, cortex = compute_level_set(healthy.mask, healthy.affine), find_boundary_voxels(healthy.mask, healthy.affine)
    if tumour.middle is None:
        site, inward = _find_site(brain, cortex, healthy.origin, tumour.site, head.smoothing_length)
        shape = _build_tumour_shape(
            tumour, lambda unit, scale: site + (tumour.cover + scale * unit.compute_radius(-inward[None])[0]) * inward
        )
    else:
        shape = _build_tumour_shape(tumour, lambda unit, scale: np.array(tumour.middle))
        site = find_reachable_site(cortex, shape.middle)
    interface = shape.middle + _sample_sphere(400) * shape.compute_radius(_sample_sphere(400))[:, None]
    if (brain(interface) > -head.clearance).any():
        raise InputError(
            f"a {tumour.shape} tumour of {tumour.radius * 1e3:g} mm radius {tumour.place} reaches out of the brain: "
            "choose a smaller radius, or another place."
        )
    volume = 4.0 / 3.0 * np.pi * tumour.radius**3
    pieces = (TumourPiece(volume, shape.middle, interface),)
    return Subject(brain, shape, cortex, interface, volume, site, healthy.intensity, notes=healthy.notes, pieces=pieces)


def scale_affine(affine: np.ndarray, centre: np.ndarray, factor: float, new_centre: np.ndarray) -> np.ndarray:
    """Return the affine (4, 4), scaled by a factor about `centre` (3,), which is then moved to `new_centre` (3,)."""
    moved = affine.copy()
    moved[:3, 3] -= centre
    moved[:3] *= factor
    moved[:3, 3] += new_centre
    return moved


def measure_centroid_and_volume(mask: np.ndarray, affine: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the centroid (3,) and the volume of the marked voxels, in the units of the affine (4, 4)."""
    centre = affine[:3, :3] @ np.argwhere(mask).mean(axis=0) + affine[:3, 3]
    return centre, float(mask.sum() * abs(np.linalg.det(affine[:3, :3])))


def _load_scaled_template(head: HeadScaling) -> HealthyHead:
    with require_extra("heads", "an anatomy of the average brain needs"):
        from nilearn.datasets import load_mni152_template  # takes seconds

    image = load_mni152_template(resolution=1)
    grey = np.asarray(image.dataobj)
    component, _ = cast(tuple[np.ndarray, int], ndimage.label(grey > head.threshold * grey.max()))
    mask = cast(np.ndarray, ndimage.binary_fill_holes(component == np.bincount(component.ravel())[1:].argmax() + 1))
    affine = np.array(image.affine, np.float64)
    centre, volume = measure_centroid_and_volume(mask, affine)
    affine = scale_affine(affine, centre, (head.volume / volume) ** (1.0 / 3.0), 1e-3 * centre)
    return HealthyHead(mask, affine, Intensity(grey, affine))


def _find_site(
    brain: Field, cortex: np.ndarray, centre: tuple[float, float, float] | None, name: str, smoothing_length: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the point (3,) [m] at which the ray to the site `name` leaves the brain, and the inward normal (3,)."""
    middle = 0.5 * (cortex.min(axis=0) + cortex.max(axis=0))
    outward = 1e-3 * np.array(SITES[name]) - (middle if centre is None else np.array(centre))
    outward /= np.linalg.norm(outward)
    along = np.arange(0.02, 0.15, 1e-5)
    site = middle + along[np.flatnonzero(brain(middle + along[:, None] * outward) < 0.0)[-1]] * outward
    near = cortex[np.linalg.norm(cortex - site, axis=1) <= 3.0 * smoothing_length]
    normal = np.linalg.eigh(np.cov(near.T))[1][:, 0]
    return site, -normal * np.sign(normal @ outward)


def _build_tumour_shape(tumour: Tumour, compute_centre: Callable[[Lobed, float], np.ndarray]) -> Lobed:
    """Return the tumour shape; `compute_centre` returns the centre for the unit-scale shape and the scale."""
    rng, lobes = np.random.default_rng(tumour.seed), tumour.lobes
    directions = rng.normal(size=(lobes.count if tumour.shape == "lobed" else 0, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    heights = rng.uniform(0.3, 1.0, len(directions)) * lobes.height
    unit = Lobed(np.zeros(3), directions, heights, 1.0, lobes.sharpness)
    scale = tumour.radius / (unit.compute_radius(_sample_sphere(20_000)) ** 3).mean() ** (1.0 / 3.0)
    return Lobed(compute_centre(unit, scale), directions, heights, scale, lobes.sharpness)


def _sample_sphere(count: int) -> np.ndarray:
    """Return unit directions (count, 3) of a Fibonacci lattice, uniform on the sphere."""
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
