"""Export of a deformed anatomy into the files of a folder."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from sim.errors import InputError
from sim.fields.warp_fields import WarpFields, build_warp_grid, compute_cutoff, compute_forward, remove_negligible

from .deformed_anatomy import DeformedAnatomy
from .images import PatientImage, WarpedImage, write_field_nifti, write_warped_image
from .landmarks import CENTROID, Landmark, compute_centroid
from .markups import write_markups
from .meshes import build_surface_mesh, write_glb, write_stl, write_vtp
from .nrrd_files import write_field_nrrd, write_field_sequence, write_segmentation
from .places import FoldedRegion, SamplePoints, SpacingSettings, compute_fields, find_folds, list_points
from .readme import write_readme

MESH_COLOURS = {"brain": (0.86, 0.72, 0.66, 0.35), "cortex": (0.86, 0.60, 0.54, 1.0), "tumour": (0.20, 0.94, 0.42, 1.0)}
"""Colours (RGBA, 0 to 1) of the surfaces, by name."""
MIN_MOTION = 1e-4  # Displacement above which a vertex moves [m].
MAX_GRID_ERROR = 0.1  # Grid error at the tumour, relative to the largest motion, above which a warning is given.
SEQUENCE_SPACING = 3e-3  # Grid spacing of a sequence [m].
MAX_VALUES = 400_000_000  # Maximum number of values of a sequence.


@dataclass(frozen=True)
class WarpSettings:
    """Settings of an export: grid spacing [m] of the fields (None: see `compute_fields`), and interpolation of images.

    `source` is the name of the anatomy's file; `step` receives the number of newly finished parts.
    """

    spacing: float | None
    order: str
    source: str
    step: Callable[[int], object] = lambda more: None


def write_warp(
    folder: Path,
    deformed: DeformedAnatomy,
    images: Sequence[PatientImage],
    settings: WarpSettings,
    sequence: Sequence[tuple[float, DeformedAnatomy]],
) -> dict[str, Any]:
    """Write all files of a deformed anatomy, and of a `sequence` of deformed anatomies with their times [s].

    Return the content of `warp.json`.

    Raises
    ------
    InputError
        See `compute_fields`; also if the sequence is too long.
    """
    begun = process_time()
    fields = compute_fields(deformed, settings.spacing, settings.step)
    seconds = process_time() - begun
    write_field_nifti(folder / "field_resampling.nii.gz", fields.grid, fields.backward)
    write_field_nrrd(folder / "field_modeling.nrrd", fields.grid, fields.forward, "modeling")
    settings.step(1)
    if sequence:
        _write_sequence(folder / "field_sequence.seq.nrrd", sequence)
        settings.step(1)
    warped = []
    for picture in images:
        warped.append(write_warped_image(folder, picture, fields, settings.order))
        settings.step(1)
    _write_surfaces(folder, deformed)
    places = list_points(deformed)
    _write_points(folder, deformed, places.named)
    settings.step(1)
    report = collect_figures(deformed, fields, places, warped, len(sequence))
    report["fields_cpu_s"] = round(seconds, 1)
    report["anatomy"] = {"file": settings.source, "digest": deformed.anatomy.digest}
    (folder / "README.txt").write_text(write_readme(report, warped))
    files = sorted(path.name for path in folder.iterdir())
    sums = {name: _compute_sha256(folder / name) for name in files}
    report = {"format": "sulcus warp 1", "files": files, "spaces": describe_spaces(files), "sha256": sums, **report}
    (folder / "warp.json").write_text(json.dumps(report, indent=1) + "\n")
    return report


def _compute_sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _write_surfaces(folder: Path, deformed_anatomy: DeformedAnatomy) -> None:
    triangles = {
        "brain": deformed_anatomy.remaining.mesh.surface,
        "cortex": deformed_anatomy.remaining.open_surface,
        "tumour": deformed_anatomy.remaining.tumour_surface,
    }
    nodes = deformed_anatomy.anatomy.mesh.nodes
    meshes = [
        build_surface_mesh(name, which, nodes, deformed_anatomy.displacement, MESH_COLOURS[name])
        for name, which in triangles.items()
        if len(which)
    ]
    for mesh in meshes:
        write_vtp(folder / f"{mesh.name}.vtp", mesh)
        write_stl(folder / f"{mesh.name}.stl", mesh)
    write_glb(folder / "deformed.glb", meshes)


def _write_points(folder: Path, deformed: DeformedAnatomy, landmarks: Sequence[Landmark]) -> None:
    points = list_named_points(deformed, landmarks)
    if points:
        write_markups(folder / "landmarks.mrk.json", "Fiducial", points)
    gap = deformed.find_gap()
    if gap is not None and deformed.tip is not None:
        write_markups(folder / "tip_to_tumour.mrk.json", "Line", {"tip": deformed.tip, "tumour": gap[0]})
    tumour = deformed.remaining.mesh.tets[deformed.remaining.in_tumour]
    if len(tumour):
        write_segmentation(folder / "tumour.seg.nrrd", deformed.positions, tumour, deformed.bound)


def list_named_points(deformed: DeformedAnatomy, landmarks: Sequence[Landmark]) -> dict[str, np.ndarray]:
    """Return points (3,) [m] by name: landmarks in the scan and deformed, deformed centroid of the tumour, and tip."""
    points = {}
    for one in landmarks:
        points |= {f"{one.name}, in the scan": one.rest, f"{one.name}, now": one.deformed}
    centroid = compute_centroid(deformed.remaining, deformed.displacement)
    others = {CENTROID: centroid, "tip": deformed.tip}
    return points | {name: point for name, point in others.items() if point is not None}


def _write_sequence(path: Path, sequence: Sequence[tuple[float, DeformedAnatomy]]) -> None:
    anatomy = sequence[0][1].anatomy
    moved = np.stack([remove_negligible(moment.displacement) for _, moment in sequence])
    grid = build_warp_grid(anatomy, moved, SEQUENCE_SPACING)
    if 3 * np.prod(grid.shape) * len(sequence) > MAX_VALUES:
        raise InputError(f"--sequence: {len(sequence)} moments are too many. Give a larger step.")
    pairs = zip(sequence, moved, strict=True)
    fields = [compute_forward(grid, moment.remaining, displacement)[0] for (_, moment), displacement in pairs]
    write_field_sequence(path, grid, fields, [time for time, _ in sequence])


def describe_spaces(files: Sequence[str]) -> dict[str, str]:
    """Return the coordinate system of each file, by file name, and of the coordinates in `warp.json`."""
    known = {"field_resampling.nii.gz": "RAS, mm", "deformed.glb": "left, head, front, m"}
    endings = {".nii.gz": "that of the image", ".txt": ""}
    found = {name: known.get(name, endings.get(name[name.find(".") :], "LPS, mm")) for name in files}
    return {"cause": "RAS, mm", **{name: space for name, space in found.items() if space}}


def collect_figures(
    deformed: DeformedAnatomy, fields: WarpFields, samples: SamplePoints, images: Sequence[WarpedImage], frames: int
) -> dict[str, Any]:
    """Return the results of an export by name: lengths [mm], volume ratios, numbers of voxels, and warnings."""
    error = 1e3 * samples.compute_errors(fields)
    moving = np.linalg.norm(samples.displacement, axis=1) > MIN_MOTION
    gap, largest = deformed.find_gap(), 1e3 * float(np.linalg.norm(deformed.displacement, axis=1).max())
    of_tumour = _summarise_errors(error[samples.tumour])
    folds = find_folds(deformed, fields)
    return {
        "moved_by": deformed.cause.description,
        "cause": dict(deformed.cause.record),
        "converged": deformed.converged,
        "largest_displacement_mm": largest,
        "tip_to_tumour_mm": None if gap is None else 1e3 * gap[1],
        "bound_mm": None if deformed.bound is None else 1e3 * deformed.bound,
        "bound_of": deformed.bound_text,
        "spacing_mm": round(1e3 * fields.grid.spacing, 6),
        "nodes": list(fields.grid.shape),
        "reach_mm": 1e3 * fields.fade_distance,
        "faint_mm": 1e3 * compute_cutoff(deformed.displacement),
        "least_jacobian": dict(zip(("modeling", "resampling", "tetrahedra"), fields.min_determinants, strict=True)),
        "grid_error_mm": {
            "median": float(np.median(error)),
            "moved_p95": _summarise_errors(error[moving])["p95"],
            "worst": float(error.max()),
            "tumour": of_tumour,
            "cortex": _summarise_errors(error[samples.cortex]),
            "landmarks_worst": _summarise_errors(error[samples.landmarks])["worst"],
        },
        "landmarks": [one.name for one in samples.named],
        "images": [vars(one) for one in images],
        "sequence_frames": frames,
        "fields_fold": fields.has_folds,
        "folds": [_summarise_fold(fold) for fold in folds],
        "warnings": _list_warnings(largest, of_tumour["worst"], folds),
    }


def _summarise_errors(error: np.ndarray) -> dict[str, float]:
    if not len(error):
        return {"p95": 0.0, "worst": 0.0}
    return {"p95": float(np.quantile(error, 0.95)), "worst": float(error.max())}


def _summarise_fold(fold: FoldedRegion) -> dict[str, Any]:
    return {
        "tetrahedra": fold.tetrahedra,
        "middle_in_scan_mm": [round(1e3 * value, 3) for value in fold.centre],
        "volume_in_scan_mm3": 1e9 * fold.volume,
        "fields_off_mm": 1e3 * fold.field_error,
    }


def _list_warnings(largest: float, of_tumour: float, folds: Sequence[FoldedRegion]) -> list[str]:
    found = []
    for fold in folds:
        x, y, z = (f"{1e3 * value:.1f}" for value in fold.centre)
        found.append(
            f"the finite elements fold {1e9 * fold.volume:.2f} mm3 at {x}, {y}, {z} mm in the scan (RAS). The fields "
            f"do not: there they differ by up to {1e3 * fold.field_error:.2f} mm, and are not to be relied on."
        )
    if of_tumour > max(MAX_GRID_ERROR * largest, 1e3 * SpacingSettings().tolerance):
        found.append(
            f"the grid is coarse for this tumour: its error of {of_tumour:.2f} mm is more than a tenth of the largest "
            f"motion, {largest:.2f} mm. Give a smaller --spacing."
        )
    return found
