"""Voxel labels by number or name, and resampling of masks between voxel grids."""

import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy import ndimage

from ..errors import InputError
from ..runtime.file_limits import MAX_VOXELS
from .volume import read_volume
from .voxels import DEFAULT_VOXELS, Segment, VoxelGrid, VoxelSpec

# Maximum distance of a label from an integer, as left by scaling or resampling.
LABEL_TOLERANCE = 1e-3

Label = int | str
"""Label, given by its number or by its name in the file."""


@dataclass(frozen=True, eq=False)
class LabelMap:
    """Integer label volume.

    Parameters
    ----------
    path
        File path, for error messages.
    layers
        Labels (I, J, K, L); in most files the number of layers L is 1.
    affine
        (4, 4) from indices to metres (RAS).
    notes
        Notes for the user on assumptions made while reading.
    segments
        Named labels, if the file has names.
    """

    path: Path
    layers: np.ndarray
    affine: np.ndarray
    notes: tuple[str, ...]
    segments: tuple[Segment, ...]

    @cached_property
    def labels_by_layer(self) -> tuple[frozenset[int], ...]:
        """Set of the nonzero labels in each layer."""
        layers = np.moveaxis(self.layers, -1, 0)
        return tuple(frozenset(np.unique(layer.T).astype(int).tolist()) - {0} for layer in layers)

    @property
    def labels(self) -> frozenset[int]:
        """Set of the nonzero labels in all layers."""
        return frozenset().union(*self.labels_by_layer)

    def mask(self, labels: Sequence[Label]) -> np.ndarray:
        """Return a mask (I, J, K) of the voxels with one of these labels or, if `labels` is empty, with any label.

        Raises
        ------
        InputError
            See `find_layers`.
        """
        found = np.asarray(self.layers.any(axis=-1)) if not labels else np.zeros(self.layers.shape[:3], bool, order="F")
        places = self.find_layers(labels)
        for layer in {layer for layer, _ in places}:
            # Transposed: files have the first axis fastest, and NumPy would copy other memory layouts.
            found |= np.isin(self.layers[..., layer].T, [value for on, value in places if on == layer]).T
        return found

    def find_layers(self, labels: Sequence[Label]) -> list[tuple[int, int]]:
        """Return layer and number of each label.

        Raises
        ------
        InputError
            A label does not occur or is 0, or several layers use the same number.
        """
        found = [self._find_matches(label) for label in labels]
        missing = [label for label, at in zip(labels, found, strict=True) if not at]
        if missing or 0 in labels:
            wrong = (
                f"has no label {format_labels(missing)}" if missing and missing != [0] else "has label 0 as background"
            )
            raise InputError(f"{self.path}: {wrong}. Choose from {self._format_labels()}.")
        for label, at in zip(labels, found, strict=True):
            if len(at) > 1:
                raise InputError(f"{self.path}: several segments {self._format_conflict(label, at)}.")
        return [at[0] for at in found]

    def _find_matches(self, label: Label) -> list[tuple[int, int]]:
        if isinstance(label, int):
            return [(layer, label) for layer, present in enumerate(self.labels_by_layer) if label in present]
        composed = {one: unicodedata.normalize("NFC", one.name) for one in self.segments}
        wanted = unicodedata.normalize("NFC", label)
        alike = [one for one, name in composed.items() if name == wanted]
        alike = alike or [one for one, name in composed.items() if name.casefold() == wanted.casefold()]
        return [(one.layer, one.value) for one in alike if one.value in self.labels_by_layer[one.layer]]

    def _format_conflict(self, label: Label, matches: list[tuple[int, int]]) -> str:
        """Return a message that several segments match one label, with the remedy."""
        if isinstance(label, int):
            names = ", ".join(sorted(one.name for one in self.segments if (one.layer, one.value) in matches))
            return f"have the label {label}: name one of {names}"
        numbers = sorted(value for _, value in matches)
        clear = all(len(self._find_matches(number)) == 1 for number in numbers)
        remedy = f"give its number, of {', '.join(map(str, numbers))}" if clear else "rename all but one in 3D Slicer"
        return f"are called {label}: {remedy}"

    def _format_labels(self) -> str:
        if self.segments:
            return format_labels([one.name for one in self.segments if one.value in self.labels_by_layer[one.layer]])
        return format_labels(sorted(self.labels))


def read_labels(path: str | Path, spec: VoxelSpec = DEFAULT_VOXELS) -> LabelMap:
    """Return the label map in a file; values within 1e-3 of integers are rounded, with a note.

    Raises
    ------
    InputError
        `read_volume` rejects the file, or its values are not integers or are all 0.
    """
    volume = read_volume(path, spec, allow_layers=True)
    values, notes = volume.values, volume.notes
    if values.dtype.kind == "f":
        whole = np.rint(values)
        if not has_integers(values) or np.abs(whole).max() > 2**31 - 1:
            raise InputError(f"{path}: holds fractions, so it is no label volume. Give whole-number labels.")
        if not np.array_equal(values, whole):
            notes = (*notes, f"its labels are rounded by up to {np.abs(values - whole).max():.1g}")
        values = whole.astype(np.int32)
    if not values.any():
        raise InputError(f"{path}: is empty, every voxel is 0. Export the labels again.")
    layers = values if values.ndim == 4 else values[..., None]
    return LabelMap(Path(path), layers, volume.affine, notes, volume.segments)


def has_integers(values: np.ndarray) -> bool:
    """Return True if all values are integers, up to the round-off of a scale factor in the file."""
    return bool((np.abs(values - np.rint(values)) <= LABEL_TOLERANCE).all())


def format_labels(labels: Sequence[Label]) -> str:
    """Return a text with the first twenty labels and, if there are more, the total number."""
    shown = ", ".join(map(str, labels[:20]))
    return f"{shown}, ... ({len(labels)} in all)" if len(labels) > 20 else shown


@dataclass(frozen=True, eq=False)
class Mask:
    """Mask of a file: `voxels` (I, J, K) bool, `affine` (4, 4) from voxel indices to metres (RAS), and notes."""

    path: Path
    voxels: np.ndarray
    affine: np.ndarray
    notes: tuple[str, ...] = ()

    @cached_property
    def outline(self) -> np.ndarray:
        """First and last marked voxel of each row, as points (n, 3) [m]; same convex hull as all marked voxel centres.

        Raises
        ------
        InputError
            The mask is empty.
        """
        rows = np.argwhere(self.voxels.any(axis=2))
        if not len(rows):
            raise InputError(f"{self.path}: is empty, every voxel is 0. Export it again.")
        first = self.voxels.argmax(axis=2)
        last = self.voxels.shape[2] - 1 - self.voxels[..., ::-1].argmax(axis=2)
        ends = np.concatenate([np.column_stack([rows, end[tuple(rows.T)]]) for end in (first, last)])
        return ends @ self.affine[:3, :3].T + self.affine[:3, 3]

    @property
    def grid(self) -> VoxelGrid:
        """Voxel grid of the mask."""
        return VoxelGrid(self.path, self.voxels.shape, self.affine)

    @property
    def box(self) -> np.ndarray:
        """Lowest and highest corner (2, 3) [m] of the bounding box (RAS) of the centres of the marked voxels."""
        return np.stack([self.outline.min(axis=0), self.outline.max(axis=0)])

    def resample(self, shape: tuple[int, ...], affine: np.ndarray) -> np.ndarray:
        """Return the mask (I, J, K), resampled to another voxel grid by nearest neighbour."""
        if _is_same_grid(shape, affine, self):
            return self.voxels
        matrix = np.linalg.inv(self.affine) @ affine
        found = ndimage.affine_transform(
            self.voxels.view(np.uint8), matrix, output_shape=shape, order=0, mode="constant"
        )
        return found.view(bool)


def widen_grid(shape: tuple[int, ...], affine: np.ndarray, mask: Mask) -> tuple[np.ndarray, np.ndarray]:
    """Return the padding (3, 2) [voxels] of each axis that a grid needs to contain `mask`, and the new affine (4, 4).

    If the grids differ, a margin of one voxel is added.

    Raises
    ------
    InputError
        The padded grid would exceed `MAX_VOXELS`.
    """
    inverse = np.linalg.inv(affine)
    index = mask.outline @ inverse[:3, :3].T + inverse[:3, 3]
    margin = 0 if _is_same_grid(shape, affine, mask) else 1
    low = np.maximum(0, margin - np.floor(index.min(axis=0)).astype(int))
    high = np.maximum(0, margin + np.ceil(index.max(axis=0)).astype(int) - np.array(shape) + 1)
    voxels = float(np.prod(np.array(shape, float) + low + high))
    if voxels > MAX_VOXELS:
        raise InputError(
            f"{mask.path}: on the labels' grid it takes {voxels:.3g} voxels; the maximum is {MAX_VOXELS:.3g}. "
            "Resample the labels more coarsely."
        )
    moved = affine.copy()
    moved[:3, 3] -= affine[:3, :3] @ low
    return np.stack([low, high], axis=1), moved


def _is_same_grid(shape: tuple[int, ...], affine: np.ndarray, mask: Mask) -> bool:
    """Return True if `mask` has this grid."""
    return shape == mask.voxels.shape and np.allclose(affine, mask.affine, rtol=0.0, atol=1e-9)


def count_border(mask: np.ndarray) -> int:
    """Return the number of marked voxels on the border of the volume (I, J, K)."""
    return int(mask.sum() - mask[1:-1, 1:-1, 1:-1].sum())
