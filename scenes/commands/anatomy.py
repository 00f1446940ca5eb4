"""`sulcus anatomy`: build a tetrahedral brain with a tumour, from a label volume or synthetic in a healthy head."""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from sim.anatomy import PART_LABELS, Anatomy, name_region
from sim.bodies.dural_septa import find_fixed_vertices
from sim.bodies.head_masks import read_head_masks
from sim.bodies.intensity import to_intensity_path, write_intensity
from sim.bodies.label_volume import build_masked_subject
from sim.bodies.mesher import compute_surface_errors, describe_lost_pieces, find_lost_pieces
from sim.bodies.meshfile import write_anatomy
from sim.bodies.placement import describe_side
from sim.bodies.subject import MeshPlan, Subject, make_anatomy
from sim.errors import InputError
from sim.geometry.tetmesh import compute_dihedral_angles
from sim.runtime.timing import time_stage

from ..options.outputs import add_force, check_no_foreign_files, check_output_path
from ..options.placement_options import add_craniotomy_arguments, describe_craniotomy, place_craniotomy, to_metres
from ..options.shared_options import add_json
from ..options.subject_options import (
    add_label_options,
    add_synthetic_arguments,
    build_drawn_subject,
    check_no_synthetic_options,
    describe_source,
    list_label_options,
    parse_regions,
    parse_sources,
)

DEFAULTS = {  # Default values of the options; lengths in millimetres, as on the command line.
    "radius": 12.0,
    "cover": 10.0,
    "tumour_shape": "sphere",
    "site": "central",
    "craniotomy": None,
}
PRESETS = {  # Values of the options that differ from the default, by preset.
    "default": {},
    "superficial": {"cover": 3.0},
    "subcortical": {"cover": 10.0},
    "deep": {"cover": 25.0},
    # Tonutti et al. 2017: forces act 20 mm from the centre of a tumour of 12 mm radius; 98 cm2 of open cortex.
    "seed": {"cover": 8.0, "craniotomy": 110.0},
}
MIN_REPORTED_LOSS = 3.0
"""Smallest difference of the tumour's volume in the mesh from the labels that is reported [%]."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument("--out", required=True, type=Path, metavar="MESH.vtu", help="output mesh [m, RAS]")
    parser.add_argument(
        "--preset", choices=tuple(PRESETS), default="default", help="values of the options that are not given"
    )
    add_craniotomy_arguments(parser)
    own = parser.add_argument_group("your own brain")
    own.add_argument("--labels", type=Path, metavar="FILE.nii.gz", help="label volume; without it, a tumour is drawn")
    add_label_options(own, "--convention")
    own.add_argument(
        "--t1", type=Path, metavar="FILE.nii.gz", help="intensities in the same space, for the camera view"
    )
    add_synthetic_arguments(parser)
    add_force(parser)
    add_json(parser, "print the summary as one line of JSON")


def run(args: argparse.Namespace) -> int:
    """Build the anatomy, write it to a file, and print a summary; return 0."""
    began = time.perf_counter()
    read = (args.labels, args.mask, args.tumour_in, args.t1)
    check_output_path(args.out, ".vtu", args.force, read)
    beside = to_intensity_path(args.out)
    check_output_path(beside, ".gz", args.force, read)
    given = {name: getattr(args, name) for name in DEFAULTS if getattr(args, name) is not None}
    chosen = {**DEFAULTS, **PRESETS[args.preset], **given}
    plan = MeshPlan(args.nodes, to_metres(chosen["craniotomy"]), fine_opening=args.fine_opening)
    with time_stage("labels" if args.labels else "head" if args.mask or args.head else "template"):
        subject = place_craniotomy(_build_subject(args, chosen), args)
    for note in subject.notes:
        print(f"{describe_source(args)}: {note}", file=sys.stderr)
    print(f"sulcus anatomy: meshing with about {plan.nodes} nodes ...", file=sys.stderr)
    with time_stage("mesh"):
        anatomy = make_anatomy(subject, plan)
    for path in check_no_foreign_files(args.out, anatomy.digest, args.force):
        print(f"{path}: belongs to the replaced anatomy: simulate and train again.", file=sys.stderr)
    with time_stage("write the mesh"):
        intensity = subject.intensity and subject.intensity.crop(anatomy.mesh.nodes[anatomy.craniotomy], anatomy.mesh)
        write_anatomy(args.out, anatomy)
        if intensity is None:
            beside.unlink(missing_ok=True)  # belongs to an earlier mesh of this name
        else:
            write_intensity(beside, intensity)
    tumour = anatomy.mesh.tets[anatomy.in_tumour]
    lost = find_lost_pieces(subject.pieces, anatomy.mesh.nodes, tumour)
    if any(lost):
        pieces = describe_lost_pieces(subject.pieces, lost)
        print(f"{args.out}: does not hold {pieces}: where they matter, ask for more nodes.", file=sys.stderr)
    figures = _summarise_anatomy(args, anatomy, subject, lost)
    missed = figures["tumour_volume_error_percent"]
    if abs(missed) > MIN_REPORTED_LOSS:
        print(
            f"{args.out}: holds {abs(missed):.1f} % {'less' if missed < 0.0 else 'more'} tumour than "
            f"{describe_source(args)}: where that matters, ask for more nodes.",
            file=sys.stderr,
        )
    for part in subject.parts:
        if not anatomy.mesh.mark_elements(part.label).any():
            message = f"has no {name_region(part.label)}, of which the labels mark {1e6 * part.volume:.2g} ml"
            print(f"{args.out}: {message}: where it matters, ask for more nodes.", file=sys.stderr)
    files = {"mesh": str(args.out), "t1": None if intensity is None else str(beside)}
    summary = {**files, **figures, "seconds": round(time.perf_counter() - began, 2)}
    print(json.dumps(summary) if args.json else _format_report(summary))
    return 0


def _build_subject(args: argparse.Namespace, tumour_options: dict) -> Subject:
    if args.labels is None:
        for option in list_label_options(args):
            raise InputError(f"{option} belongs to a label volume: give --labels FILE.nii.gz too, or leave it out.")
        return build_drawn_subject(args, tumour_options)
    check_no_synthetic_options(args)
    return build_masked_subject(read_head_masks(parse_sources(args)), args.t1, regions=parse_regions(args))


def _summarise_anatomy(
    args: argparse.Namespace, anatomy: Anatomy, subject: Subject, lost_pieces: list[bool]
) -> dict[str, Any]:
    mesh = anatomy.mesh
    volume = mesh.volumes[anatomy.in_tumour].sum()
    error, weight = compute_surface_errors(mesh.nodes, mesh.surface, subject.brain)
    septa = [int((find_fixed_vertices(mesh, one) & anatomy.fixed.all(axis=1)).sum()) for one in subject.septa]
    regions = {
        name_region(part.label): (float(mesh.volumes[mesh.mark_elements(part.label)].sum()), part)
        for part in subject.parts
    }
    return {
        "nodes": len(mesh.nodes),
        "tets": len(mesh.tets),
        "tumour_nodes": len(anatomy.tumour_nodes),
        "craniotomy_nodes": int(anatomy.craniotomy.sum()),
        "held_nodes": int(anatomy.fixed.any(axis=1).sum()),
        "septa_nodes": {septum.name: held for septum, held in zip(subject.septa, septa, strict=True)},
        "sliding_nodes": int(anatomy.slide_normal.any(axis=1).sum()),
        "worst_dihedral_deg": round(float(compute_dihedral_angles(mesh.nodes, mesh.tets).min()), 2),
        "brain_ml": round(float(mesh.volumes.sum()) * 1e6, 2),
        "tumour_ml": round(float(volume) * 1e6, 4),
        "regions_ml": {name: round(1e6 * held, 3) for name, (held, _) in regions.items()},
        "regions_volume_error_percent": {
            name: round(100.0 * (held / part.volume - 1.0), 3) if part.volume else None
            for name, (held, part) in regions.items()
        },
        "tumour_volume_error_percent": round(100.0 * float(volume / subject.tumour_volume - 1.0), 3),
        "surface_error_mean_mm": round(1e3 * float(np.average(error, weights=weight)), 3),
        "surface_error_p95_mm": round(1e3 * float(np.quantile(error, 0.95, weights=weight, method="inverted_cdf")), 3),
        "opening": {"over": describe_craniotomy(args), **_describe_position(subject, subject.site)},
        "tumour_pieces": [
            {"ml": round(1e6 * piece.volume, 3), "lost": gone, **_describe_position(subject, piece.centre)}
            for piece, gone in zip(subject.pieces, lost_pieces, strict=True)
        ],
        "digest": anatomy.digest,
    }


def _describe_position(subject: Subject, position: np.ndarray) -> dict[str, Any]:
    """Return the position of a point (3,) [m] for JSON, in millimetres and in words."""
    low, high = subject.cortex.min(axis=0), subject.cortex.max(axis=0)
    return {"at_mm": [round(1e3 * value, 1) for value in position.tolist()], "side": describe_side(position, low, high)}


def _format_position(position: dict[str, Any]) -> str:
    at = ", ".join(f"{value:g}" for value in position["at_mm"])
    return f"{position['side']}, at {at} mm (right, anterior, superior)"


def _format_pieces(pieces: list[dict[str, Any]], opened_piece: str) -> list[str]:
    if len(pieces) == 1:
        return [f"tumour: {_format_position(pieces[0])}"]
    listed = [
        f"  piece {number}: {piece['ml']:g} ml, {_format_position(piece)}{', not in the mesh' if piece['lost'] else ''}"
        for number, piece in enumerate(pieces, start=1)
    ]
    return [f"tumour: {len(pieces)} pieces; the skull is opened over {opened_piece}", *listed]


def _format_region(name: str, volume: float, figures: dict) -> str:
    """Format the output line of a region: name, volume [ml], volume error and region label."""
    missed = figures["regions_volume_error_percent"][name]
    off = "" if missed is None else f" ({missed:+} % of the label's)"
    return f"{name} {volume:g} ml{off}, region {PART_LABELS[name]}{' of the tumour' if name == 'necrosis' else ''}"


def _format_report(figures: dict) -> str:
    lines = [
        "{nodes} nodes, {tets} tetrahedra; worst dihedral angle {worst_dihedral_deg} deg",
        "brain {brain_ml:.0f} ml; surface error {surface_error_mean_mm} mm mean, {surface_error_p95_mm} mm p95",
        "tumour {tumour_ml} ml ({tumour_volume_error_percent:+} % of the label's), {tumour_nodes} nodes",
        *(_format_region(name, volume, figures) for name, volume in figures["regions_ml"].items()),
        *(f"{name} {held} nodes that do not move" for name, held in figures["septa_nodes"].items()),
        *_format_pieces(figures["tumour_pieces"], figures["opening"]["over"]),
        f"opening: {_format_position(figures['opening'])}",
        "craniotomy {craniotomy_nodes} nodes free, {sliding_nodes} at the skull, {held_nodes} fixed",
        "written to {mesh}" + (", intensities to {t1}" if figures["t1"] else "") + " in {seconds} s",
    ]
    return "\n".join(lines).format(**figures)
