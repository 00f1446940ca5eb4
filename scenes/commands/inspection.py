"""Preview of an anatomy from a patient's labels without meshing: volumes, depth, craniotomy and warnings."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from sim.anatomy import NECROSIS_LABEL, TUMOUR_LABEL, name_region
from sim.bodies.dural_septa import SEPTA
from sim.bodies.head_masks import NECROSIS, HeadMasks
from sim.bodies.placement import describe_side
from sim.bodies.space_consistency import compute_inside_fraction
from sim.bodies.subject import Subject
from sim.effects import Elasticity
from sim.material import Tissue

from ..options.tissue_options import check_stiffness


@dataclass(frozen=True)
class InspectionLimits:
    """Limits beyond which `inspect_subject` warns."""

    # Smallest volume of an adult brain with its ventricles [ml]: below, a mask lacks a part.
    min_brain_ml: float = 850.0
    # Largest volume of an adult brain with its ventricles [ml]: above, a mask contains more than brain.
    max_brain_ml: float = 2000.0
    # Largest volume of a tumour relative to the brain: labels of another convention are often larger.
    max_tumour_share: float = 0.25
    # Distance from the craniotomy to the tumour above which a press on the cortex does not move it [m].
    max_tumour_distance: float = 0.040
    # Ratio of the longest to the shortest edge of a voxel above which surfaces show steps along one axis.
    max_voxel_ratio: float = 2.5
    min_t1_coverage: float = 0.98  # Smallest share of the brain that a T1 in the same space covers.
    max_sheet_ml: float = 40.0  # Largest volume of a sheet of dura, a few voxels thick [ml].


AXES = ("LR", "PA", "IS")  # Letters of the negative and positive direction of each RAS axis.
MAX_LISTED_PIECES = 4  # Maximum number of pieces that are listed.


@dataclass(frozen=True)
class Inspection:
    """Result of an inspection of a label map; lengths are in mm, volumes in ml.

    Parameters
    ----------
    brain, tumour
        Volumes of brain (with tumour) and tumour.
    pieces
        Pieces of the tumour: volume and position in words, the largest first.
    parts
        Volumes of the other tissues in the label map.
    regions
        Descriptions of the tumour's tissue and of the parts that become regions.
    depth
        Distance from the tumour to the nearest cortex.
    opening
        Position of the craniotomy's centre (RAS).
    place
        Description of the craniotomy's position in words.
    distance
        Distance from the centre of the craniotomy to the tumour.
    voxel
        Edge lengths of a voxel; the longest edge bounds the error of the other lengths.
    axes, mirrored
        Directions of the file's axes, as three letters (R or L, A or P, S or I); True if the axes are left-handed.
    warnings
        Warnings as sentences.
    """

    brain: float
    tumour: float
    pieces: tuple[tuple[float, str], ...]
    parts: dict[str, float]
    regions: dict[str, str]
    depth: float
    opening: tuple[float, float, float]
    place: str
    distance: float
    voxel: tuple[float, float, float]
    axes: str
    mirrored: bool
    warnings: tuple[str, ...]

    def format_lines(self) -> list[str]:
        """Format the result as lines of text."""
        error = max(self.voxel)
        pieces = [f"  piece {number}: {size:.2f} ml, {place}" for number, (size, place) in enumerate(self.pieces, 1)]
        shown, hidden = pieces[:MAX_LISTED_PIECES], len(pieces) - MAX_LISTED_PIECES
        at = ", ".join(f"{value:.0f}" for value in self.opening)
        plural = "" if len(pieces) == 1 else "s"
        return [
            f"brain {self.brain:.0f} ml; tumour {self.tumour:.2f} ml in {len(pieces)} piece{plural}, "
            f"{self.regions['tumour']}",
            *shown,
            *([f"  and {hidden} smaller"] if hidden > 0 else []),
            *(f"{name} {size:.2f} ml: {self._describe_part(name)}" for name, size in self.parts.items()),
            f"tumour {self.depth:.0f} mm under the nearest cortex, within one voxel ({error:.1f} mm)",
            f"opening: {self.place}, at {at} mm (RAS), {self.distance:.0f} mm from the tumour",
            f"voxels {' x '.join(f'{edge:.3g}' for edge in self.voxel)} mm, stored {self.axes} "
            f"({'mirrored, as many scanners do' if self.mirrored else 'not mirrored'}; sides from its affine)",
        ]

    def _describe_part(self, part: str) -> str:
        if part in SEPTA:
            return "a wall, which does not move"
        around = "tumour" if part == NECROSIS else "brain"
        return f"a region of its own, {self.regions[part]}" if part in self.regions else f"{around} like the rest"

    def to_json(self) -> dict[str, Any]:
        """Convert the result to a JSON object, with units in names; rounded to 1 ul, 0.1 mm, and 1 um for voxels."""
        pieces = [{"ml": round(volume, 3), "side": place} for volume, place in self.pieces]
        return {
            "brain_ml": round(self.brain, 3),
            "tumour_ml": round(self.tumour, 3),
            "tumour_pieces": pieces,
            "parts_ml": {name: round(volume, 3) for name, volume in self.parts.items()},
            "regions": self.regions,
            "depth_mm": round(self.depth, 1),
            "opening": {"at_mm": [round(value, 1) + 0.0 for value in self.opening], "side": self.place},
            "distance_mm": round(self.distance, 1),
            "voxel_mm": [round(edge, 3) for edge in self.voxel],
            "axes": self.axes,
            "mirrored": self.mirrored,
            "warnings": list(self.warnings),
        }


def inspect_subject(
    masks: HeadMasks, subject: Subject, regions: Mapping[int, Tissue], limits: InspectionLimits = InspectionLimits()
) -> Inspection:
    """Inspect the `masks` of a label map and the `subject` built from them, with tissues of regions by label."""
    affine = masks.affine
    edges, voxel = 1e3 * np.linalg.norm(affine[:3, :3], axis=0), 1e6 * abs(float(np.linalg.det(affine[:3, :3])))
    low, high = subject.cortex.min(axis=0), subject.cortex.max(axis=0)
    marked = masks.brain | masks.tumour
    found = Inspection(
        brain=voxel * float(marked.sum()),
        tumour=1e6 * subject.tumour_volume,
        pieces=tuple((1e6 * one.volume, describe_side(one.centre, low, high)) for one in subject.pieces),
        parts={name: voxel * float(mask.sum()) for name, mask in masks.parts.items()},
        regions={
            name_region(label): _describe_tissue(label, regions)
            for label in (TUMOUR_LABEL, *(part.label for part in subject.parts))
        },
        depth=1e3 * float(KDTree(subject.cortex).query(subject.interface)[0].min()),
        opening=tuple((1e3 * subject.site).tolist()),
        place=describe_side(subject.site, low, high),
        distance=1e3 * float(np.linalg.norm(subject.interface - subject.site, axis=1).min()),
        voxel=tuple(edges.tolist()),
        axes=describe_axes(affine),
        mirrored=bool(np.linalg.det(affine[:3, :3]) < 0.0),
        warnings=(),
    )
    stiffness = (f"{name_region(label)}: {doubt}" for label, one in regions.items() if (doubt := check_stiffness(one)))
    return replace(found, warnings=(*subject.notes, *stiffness, *_find_warnings(found, subject, limits)))


def _describe_tissue(label: int, regions: Mapping[int, Tissue]) -> str:
    """Describe the tissue of the region with this label."""
    tissue = Elasticity(None, regions).get_law(label)
    around = "tumour" if label == NECROSIS_LABEL else "brain"
    return f"as stiff as the {around}" if tissue is None else str(tissue)


def describe_axes(affine: np.ndarray) -> str:
    """Return three letters for the directions of a volume's axes, from its affine matrix (4, 4) to RAS."""
    letters, taken = [], set()
    for column in affine[:3, :3].T / np.linalg.norm(affine[:3, :3], axis=0)[:, None]:
        axis = next(axis for axis in np.argsort(-np.abs(column)) if axis not in taken)
        taken.add(axis)
        letters.append(AXES[axis][int(column[axis] > 0.0)])
    return "".join(letters)


def _find_warnings(result: Inspection, subject: Subject, limits: InspectionLimits) -> Iterator[str]:
    if not limits.min_brain_ml <= result.brain <= limits.max_brain_ml:
        small = result.brain < limits.min_brain_ml
        word, ask = ("small", "is the mask whole") if small else ("large", "does the mask hold the skull")
        yield f"a brain of {result.brain:.0f} ml is {word} for an adult: {ask}?"
    if result.tumour > limits.max_tumour_share * result.brain:
        yield f"the tumour has {100.0 * result.tumour / result.brain:.0f} % of the brain: are these its labels?"
    if result.depth <= max(result.voxel):
        yield "the tumour touches the cortex"
    for septum in subject.septa:
        if result.parts[septum.name] > limits.max_sheet_ml:
            yield f"a {septum.name} of {result.parts[septum.name]:.0f} ml is no sheet: are these its labels?"
        if KDTree(septum.points).query(subject.interface)[0].min() <= 1e-3 * max(result.voxel):
            yield f"the tumour touches the {septum.name}, where it does not move"
    if len(result.pieces) > 1:
        yield (
            f"the tumour lies in {len(result.pieces)} pieces, and the skull is opened over one of them: --opening-over "
            "chooses another"
        )
    if 1e-3 * result.distance > limits.max_tumour_distance:
        yield f"the opening lies {result.distance:.0f} mm from the tumour: pressing there will hardly move it"
    if max(result.voxel) > limits.max_voxel_ratio * min(result.voxel):
        yield f"voxels are up to {max(result.voxel):.1f} mm long: surfaces have steps of that size"
    if subject.intensity is not None:
        covered = compute_inside_fraction(subject.intensity.values.shape, subject.intensity.affine, subject.cortex)
        if covered < limits.min_t1_coverage:
            yield f"the T1 holds {100.0 * covered:.0f} % of the brain's surface: is it of the same space?"
