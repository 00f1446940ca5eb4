"""Command-line options of the craniotomy, shared by the commands `anatomy` and `patient`."""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from sim.bodies.markups import Markup, read_markup
from sim.bodies.placement import find_opening_at, find_opening_over, find_opening_within
from sim.bodies.subject import Subject
from sim.errors import InputError

Point = tuple[float, float, float]
LINE_POINTS = 2000  # Number of points of a trajectory that are compared with the brain.


def add_craniotomy_arguments(parser: argparse.ArgumentParser) -> None:
    """Add --nodes, --craniotomy, --fine-opening, and the exclusive --opening-at and --opening-over to a parser."""
    parser.add_argument("--nodes", type=int, default=5300, metavar="N", help="number of mesh nodes, 2000 to 250000")
    parser.add_argument(
        "--craniotomy", type=float, metavar="MM",
        help="diameter of the opening along the cortex [mm] (default: 20 mm more than the tumour, at least 50)",
    )  # fmt: skip
    place = parser.add_mutually_exclusive_group()
    place.add_argument(
        "--opening-at", type=point_or_file, metavar="X,Y,Z|FILE.mrk.json",
        help="centre of the craniotomy, on the nearest accessible point of the cortex [mm, RAS] (default: over the "
        "tumour). A file of 3D Slicer may hold a point, a trajectory as a line, or an outline as a closed curve",
    )  # fmt: skip
    place.add_argument(
        "--opening-over", type=parse_opening, metavar="PIECE|X,Y,Z|FILE.mrk.json",
        help="open the skull over a piece of the tumour, by its number (1, the default, is the largest), or over a "
        "point inside the brain [mm, RAS]. A file of 3D Slicer may hold the point, or a trajectory that ends there",
    )  # fmt: skip
    parser.add_argument(
        "--fine-opening", action="store_true",
        help="halve the cells at the open cortex: contact forces depend less on the mesh, and solves take longer",
    )  # fmt: skip


def point(text: str) -> Point:
    """Parse the text X,Y,Z into three numbers, for argparse."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a point such as -30,12.5,60 [mm]") from None
    return x, y, z


def point_or_file(text: str) -> Point | Path:
    """Parse the text X,Y,Z into three numbers, or the name of a markups file into a path, for argparse."""
    return Path(text) if text.lower().endswith((".json", ".fcsv")) else point(text)


def parse_opening(text: str) -> int | Point | Path:
    """Parse the number of a tumour piece, a point X,Y,Z or the name of a markups file, for argparse."""
    return int(text) if text.isdecimal() else point_or_file(text)


def to_craniotomy_args(args: argparse.Namespace) -> list[str]:
    """Return the given craniotomy options as command-line arguments for another command."""
    given = {name: getattr(args, name) for name in ("nodes", "craniotomy", "opening_at", "opening_over")}
    texts = {
        name.replace("_", "-"): ",".join(map(repr, value)) if isinstance(value, tuple) else str(value)
        for name, value in given.items()
        if value is not None
    }
    return [f"--{name}={text}" for name, text in texts.items()] + ["--fine-opening"] * args.fine_opening


def get_trajectory_path(args: argparse.Namespace) -> Path | None:
    """Return the markups file of the craniotomy options if it contains a line; else None."""
    given = args.opening_over if args.opening_at is None else args.opening_at
    return given if isinstance(given, Path) and read_markup(given).kind == "Line" else None


def to_metres(millimetres: float | None) -> float | None:
    """Convert a length from millimetres to metres; None stays None."""
    return None if millimetres is None else 1e-3 * millimetres


def describe_craniotomy(args: argparse.Namespace) -> str:
    """Describe the target of the craniotomy: a markups file, a given point, or a piece of the tumour."""
    given = args.opening_over if args.opening_at is None else args.opening_at
    if isinstance(given, Path):
        return f"what {given} marks"
    return "the point given" if isinstance(given, tuple) else f"piece {given or 1}"


def place_craniotomy(subject: Subject, args: argparse.Namespace) -> Subject:
    """Return the subject with the craniotomy at the position that the options request.

    Raises
    ------
    InputError
        The tumour has no piece with this number; the skull cannot be opened at the point; `read_markup` rejects the
        file, or the markup is of another kind.
    """
    if isinstance(args.opening_at, Path):
        return _place_opening(subject, read_markup(args.opening_at))
    if args.opening_at is not None:
        return replace(subject, site=find_opening_at(subject.cortex, 1e-3 * np.array(args.opening_at)))
    over, pieces = args.opening_over, subject.pieces
    if over is None:
        return subject
    if isinstance(over, int):
        if not 1 <= over <= len(pieces):
            has = f"{len(pieces)} pieces: choose 1 to {len(pieces)}" if len(pieces) > 1 else "one piece: give no number"
            raise InputError(f"--opening-over {over}: the tumour has {has}.")
        place = pieces[over - 1].centre
    elif isinstance(over, Path):
        markup = read_markup(over)
        _check_kind(markup, "--opening-over", Fiducial=1, Line=2)
        place = max(markup.points, key=lambda end: _compute_depth(subject, end))
    else:
        place = 1e-3 * np.array(over)
    return replace(subject, site=find_opening_over(subject.cortex, place, _compute_depth(subject, place)))


def _compute_depth(subject: Subject, position: np.ndarray) -> float:
    """Return the depth [m] of a point (3,) below the brain surface; negative outside."""
    # Beyond a few voxels from the surface, the field of a volume gives only the side.
    apart = float(np.linalg.norm(subject.cortex - position, axis=1).min())
    return -apart if subject.brain(position[None])[0] > 0.0 else apart


def _place_opening(subject: Subject, markup: Markup) -> Subject:
    """Return the subject with the craniotomy at a point, at a trajectory's entry into the brain, or in an outline."""
    _check_kind(markup, "--opening-at", Fiducial=1, Line=2, ClosedCurve=None)
    if markup.kind == "ClosedCurve":
        outline = markup.fit_curve()
        return replace(subject, outline=outline, site=find_opening_within(subject.cortex, outline))
    ends = sorted(markup.points, key=lambda end: _compute_depth(subject, end))
    along = ends[0] + np.linspace(0.0, 1.0, LINE_POINTS)[:, None] * (ends[-1] - ends[0])
    inside = np.flatnonzero(subject.brain(along) < 0.0)
    entry = along[inside[0]] if len(inside) else ends[-1]
    return replace(subject, site=find_opening_at(subject.cortex, entry))


def _check_kind(markup: Markup, option: str, **kinds: int | None) -> None:
    """Raise InputError unless the markup is of one of the `kinds` with the given number of points (None: any)."""
    if markup.kind in kinds and kinds[markup.kind] in (None, len(markup.points)):
        return
    words = {"Fiducial": "one point", "Line": "a line of two points", "ClosedCurve": "a closed curve"}
    raise InputError(
        f"{markup.path}: holds {_describe_markup(markup)}; {option} takes "
        f"{' or '.join(words[kind] for kind in kinds)}. Save that from 3D Slicer."
    )


def _describe_markup(markup: Markup) -> str:
    """Describe the content of a markups file for a message."""
    count = "1 point" if len(markup.points) == 1 else f"{len(markup.points)} points"
    descriptions = {
        "Fiducial": f"a list of {count}",
        "Line": f"a line of {count}",
        "Curve": "an open curve",
        "ClosedCurve": "a closed curve",
        "Plane": "a plane",
        "Angle": "an angle",
        "ROI": "a box (ROI)",
    }
    return descriptions.get(markup.kind, f"markups of the kind {markup.kind}")
