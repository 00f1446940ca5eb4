"""What seems wrong with a picture of a brain: it shows little of it, nothing there, another place, or labels."""

from __future__ import annotations

import numpy as np

from sim.anatomy import Anatomy
from sim.bodies.voxels import LPS

# Less of the brain inside an image, or on voxels that are not empty, is worth a warning.
ENOUGH = 0.98, 0.5
# A voxel is dark below so much of the brightest but a few of 100: air, with the noise of a scanner.
BRIGHTEST, DARK = 99.0, 0.1
# So much more of the brain on bright voxels, and so much of it at least, once x and y are negated.
BETTER, WELL = 0.05, 0.7
# No more distinct whole values than so many are labels; one voxel in so many along an axis is looked at.
FEW, SAMPLED = 120, 3
# Labels fill areas: fewer neighbours of one value than this share are intensities.
ALIKE = 0.5


def shown(affine: np.ndarray, shape: tuple[int, ...], anatomy: Anatomy) -> float:
    """The share by volume of a brain that lies within voxels (I, J, K), whose affine leads to metres (RAS)."""
    _, inside = _voxels(affine, shape, _middles(anatomy))
    return float(np.average(inside, weights=anatomy.mesh.volumes))


def doubts(values: np.ndarray, affine: np.ndarray, labels: bool, anatomy: Anatomy) -> list[str]:
    """Sentences without their subject about a picture (I, J, K) that shows some of a brain."""
    found, middles, volumes = [], _middles(anatomy), anatomy.mesh.volumes
    index, inside = _voxels(affine, values.shape, middles)
    share = float(np.average(inside, weights=volumes))
    if share < ENOUGH[0]:
        found.append(f"shows {share:.0%} of the brain; what lies outside is not in it")
    empty = float(np.average(values[tuple(index[inside].T)] == 0, weights=volumes[inside]))
    turned = _is_turned(values, affine, labels, middles, volumes)
    if turned:
        found.append(
            f"fits the brain in {turned[0]:.0%} of its volume as it is, but in {turned[1]:.0%} with x and y negated: "
            "it may be LPS that is stated as RAS"
        )
    elif not labels and 1.0 - empty < ENOUGH[1]:
        found.append(
            f"is 0 in {empty:.0%} of the brain's volume: it may be in another space than the labels that the anatomy "
            "was made from"
        )
    if not labels and _like_labels(values):
        found.append("holds few values, all whole, as label maps do: give one by --labels, or labels are mixed")
    elif labels and (alike := _alike(values)) < ALIKE:
        found.append(
            f"has the same value in {alike:.0%} of neighbouring voxels, as intensities do: give them by --image, or "
            "values are not interpolated"
        )
    lost = int((~np.isfinite(values)).sum())
    if lost:
        found.append(f"{lost} voxels without a number are taken as 0")
    return found


def _is_turned(
    values: np.ndarray, affine: np.ndarray, labels: bool, middles: np.ndarray, volumes: np.ndarray
) -> tuple[float, float] | None:
    """Shares of the brain on bright voxels as they are, and with x and y negated, where the latter are far more."""
    part = np.nan_to_num(values[::SAMPLED, ::SAMPLED, ::SAMPLED].astype(float))
    air = 0.0 if labels else DARK * float(np.percentile(part[part > 0.0], BRIGHTEST)) if (part > 0.0).any() else 0.0
    shares = []
    for points in (middles, middles * LPS):
        index, inside = _voxels(affine, values.shape, points)
        shares.append(float(np.average(inside & (values[tuple(index.T)] > air), weights=volumes)))
    as_is, turned = shares
    return (as_is, turned) if turned > WELL and turned - as_is > BETTER else None


def _like_labels(values: np.ndarray) -> bool:
    part = values[::SAMPLED, ::SAMPLED, ::SAMPLED]
    return 1 < len(np.unique(part)) <= FEW and np.array_equal(part, np.rint(part))


def _alike(values: np.ndarray) -> float:
    """The share of voxels, but for those that are 0, that have the value of the next along the first axis."""
    one, two = values[:-1:SAMPLED, ::SAMPLED, ::SAMPLED], values[1::SAMPLED, ::SAMPLED, ::SAMPLED]
    full = (one != 0) & (two != 0)
    return float((one == two)[full].mean()) if full.any() else 1.0


def _middles(anatomy: Anatomy) -> np.ndarray:
    """Of the tetrahedra (T, 3) [m]."""
    return anatomy.mesh.nodes[anatomy.mesh.tets].mean(axis=1)


def _voxels(affine: np.ndarray, shape: tuple[int, ...], points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest voxels (n, 3) to points (n, 3) [m], and which of these lie within the volume (n,)."""
    index, last = index_of(affine, points), np.array(shape) - 1
    inside = np.asarray(((index >= -0.5) & (index <= last + 0.5)).all(axis=1))
    return np.clip(np.rint(index), 0, last).astype(int), inside


def index_of(affine: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Indices (n, 3) of points (n, 3) [m] in a volume of an affine (4, 4)."""
    return (points - affine[:3, 3]) @ np.linalg.inv(affine[:3, :3]).T
