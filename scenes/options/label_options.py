"""What is brain and what tumour, on the command line: the same options for `anatomy` and `patient`."""

from __future__ import annotations

import argparse
from pathlib import Path

from sim.anatomy import PART_LABELS
from sim.bodies.conventions import CONVENTIONS
from sim.bodies.dural_septa import SEPTA
from sim.bodies.head_masks import Sources
from sim.bodies.label_map import Label


def add_label_arguments(parser: argparse._ActionsContainer, *names: str) -> None:
    """Declare --brain, --tumour, --mask, --tumour-in, and by these `names` the convention that labels follow."""
    parser.add_argument(
        "--brain", type=labels, metavar="1,2", help="labels that are brain, by number or by a segment's name"
    )
    parser.add_argument(
        "--tumour", type=labels, metavar="3,4", help="labels that are tumour, by number or by a segment's name"
    )
    said = ". ".join(f"{name}: {one.source}" for name, one in CONVENTIONS.items())
    parser.add_argument(
        *names,
        dest="convention",
        choices=tuple(CONVENTIONS),
        help=f"whose labels they are, in place of numbers. {said}",
    )
    parser.add_argument(
        "--mask", type=Path, metavar="BRAIN.nii.gz",
        help="what is not 0 there is brain, in place of --brain, on a grid of its own",
    )  # fmt: skip
    parser.add_argument(
        "--tumour-in", type=Path, metavar="FILE", help="the file in which the tumour is marked, on a grid of its own"
    )
    add_axes(parser)
    for name, number in PART_LABELS.items():
        counts = "tumour" if name == "necrosis" else "brain"
        parser.add_argument(
            f"--{name}", type=labels, metavar="LABELS",
            help=f"labels that are {name}: they count as {counts}, and become region {number} for its own stiffness",
        )  # fmt: skip
    for name in SEPTA:
        parser.add_argument(
            f"--{name}", type=labels, metavar="LABELS",
            help=f"labels that are {name}, a sheet of dura: they count as brain, and what lies at them does not move. "
            "No convention marks it",
        )  # fmt: skip
    parser.add_argument(
        "--regions", type=lambda text: tuple(text.split(",")), default=(), metavar="NAMES",
        help=f"parts that the convention marks and that become regions, of {', '.join(PART_LABELS)}",
    )  # fmt: skip


def add_axes(parser: argparse._ActionsContainer) -> None:
    """Declare --axes, of NIfTI files that do not state their orientation."""
    parser.add_argument(
        "--axes", default="", metavar="RAS",
        help="directions of the axes of NIfTI files with neither sform nor qform, such as RAS or LPS",
    )  # fmt: skip


def labels(text: str) -> tuple[Label, ...]:
    """Numbers and names with commas between them, for argparse."""
    found = tuple(int(part) if part.strip().isdecimal() else part.strip() for part in text.split(","))
    if "" in found:
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of labels such as 1,2 or Brain,Tumour")
    return found


def sources_of(args: argparse.Namespace) -> Sources:
    """The files and labels that the options name."""
    return Sources(
        args.labels,
        args.brain or (),
        args.tumour or (),
        args.convention,
        args.mask,
        args.tumour_in,
        _parts(args),
        args.axes,
    )


def regions_asked(args: argparse.Namespace) -> tuple[str, ...]:
    """The parts of brain and tumour that become regions of their own."""
    return tuple(dict.fromkeys((*(name for name in _parts(args) if name in PART_LABELS), *args.regions)))


def _parts(args: argparse.Namespace) -> dict[str, tuple[Label, ...]]:
    return {name: getattr(args, name) for name in (*PART_LABELS, *SEPTA) if getattr(args, name) is not None}


def label_words(args: argparse.Namespace) -> list[str]:
    """The options as words for `sulcus anatomy`."""
    given = {
        "--labels": args.labels,
        "--brain": args.brain and ",".join(map(str, args.brain)),
        "--tumour": args.tumour and ",".join(map(str, args.tumour)),
        "--convention": args.convention,
        "--mask": args.mask,
        "--tumour-in": args.tumour_in,
        **{f"--{name}": ",".join(map(str, found)) for name, found in _parts(args).items()},
        "--regions": ",".join(args.regions) or None,
        "--axes": args.axes or None,
    }
    return [f"{name}={value}" for name, value in given.items() if value is not None]
