"""Where the skull is opened, on the command line: the same options for `anatomy` and `patient`."""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from sim.bodies.placement import opening_at, opening_over
from sim.bodies.subject import Subject
from sim.errors import InputError

Point = tuple[float, float, float]


def add_opening_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare --opening-at and --opening-over, of which one may be given."""
    place = parser.add_mutually_exclusive_group()
    place.add_argument(
        "--opening-at", type=point, metavar="X,Y,Z",
        help="centre the craniotomy on the nearest reachable point of the brain's surface [mm, RAS] (default: over the "
        "tumour)",
    )  # fmt: skip
    place.add_argument(
        "--opening-over", type=piece_or_point, metavar="PIECE|X,Y,Z",
        help="open the skull over a piece of the tumour, by its number (1 is the largest), or over a point inside the "
        "brain [mm, RAS] (default 1)",
    )  # fmt: skip


def point(text: str) -> Point:
    """X,Y,Z as three numbers, for argparse."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a point such as -30,12.5,60 [mm]") from None
    return x, y, z


def piece_or_point(text: str) -> int | Point:
    """A piece's number or X,Y,Z, for argparse."""
    return int(text) if text.isdecimal() else point(text)


def opening_words(args: argparse.Namespace) -> list[str]:
    """The options as words for another command."""
    given = {"--opening-at": args.opening_at, "--opening-over": args.opening_over}
    texts = {
        name: str(value) if isinstance(value, int) else ",".join(map(repr, value))
        for name, value in given.items()
        if value is not None
    }
    return [f"{name}={text}" for name, text in texts.items()]


def opened_over(args: argparse.Namespace) -> str:
    """What the skull is opened over, in words."""
    if args.opening_at is not None:
        return "the point given"
    return f"piece {args.opening_over or 1}" if not isinstance(args.opening_over, tuple) else "the point given"


def opened(subject: Subject, args: argparse.Namespace) -> Subject:
    """The subject with its skull opened where the options say.

    Raises
    ------
    InputError
        A piece that the tumour does not have; a point where nothing can be opened.
    """
    if args.opening_at is not None:
        return replace(subject, site=opening_at(subject.cortex, 1e-3 * np.array(args.opening_at)))
    over, pieces = args.opening_over, subject.pieces
    if over is None:
        return subject
    if isinstance(over, int):
        if not 1 <= over <= len(pieces):
            raise InputError(f"--opening-over {over}: the tumour has {len(pieces)} pieces: choose 1 to {len(pieces)}.")
        place = pieces[over - 1].centre
    else:
        place = 1e-3 * np.array(over)
    # Some voxels off the surface the field of a volume tells the side alone.
    apart = float(np.linalg.norm(subject.cortex - place, axis=1).min())
    depth = -apart if subject.brain(place[None])[0] > 0.0 else apart
    return replace(subject, site=opening_over(subject.cortex, place, depth))
