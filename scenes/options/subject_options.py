"""Command-line options of brain and tumour: labels of a volume, or a synthetic tumour in a healthy head."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from sim.anatomy import PART_LABELS
from sim.bodies.conventions import CONVENTIONS
from sim.bodies.dural_septa import SEPTA, synthesise_falx
from sim.bodies.head_masks import MaskSources
from sim.bodies.healthy_heads import build_masked_head, read_fsaverage_head
from sim.bodies.label_map import Label
from sim.bodies.subject import Subject
from sim.bodies.template import SITES, HeadScaling, Tumour, build_synthetic_subject, build_template_subject
from sim.errors import InputError

from .placement_options import point


def add_label_options(parser: argparse._ActionsContainer, *names: str) -> None:
    """Add the options of labels and masks to a parser; `names` are the names of the option of the label convention."""
    parser.add_argument("--brain", type=parse_labels, metavar="1,2", help="labels of brain, by number or segment name")
    parser.add_argument(
        "--tumour", type=parse_labels, metavar="3,4", help="labels of tumour, by number or segment name"
    )
    sources = ". ".join(f"{name}: {one.source}" for name, one in CONVENTIONS.items())
    parser.add_argument(
        *names, dest="convention", choices=tuple(CONVENTIONS),
        help=f"label convention, instead of label numbers. {sources}",
    )  # fmt: skip
    parser.add_argument(
        "--mask", type=Path, metavar="BRAIN.nii.gz",
        help="brain mask (non-zero voxels), instead of --brain; may have its own grid",
    )  # fmt: skip
    parser.add_argument("--tumour-in", type=Path, metavar="FILE", help="label map of the tumour, on its own grid")
    add_axes(parser)
    for name, number in PART_LABELS.items():
        counts = "tumour" if name == "necrosis" else "brain"
        parser.add_argument(
            f"--{name}", type=parse_labels, metavar="LABELS",
            help=f"labels of {name}; part of the {counts}, and region {number} with its own stiffness",
        )  # fmt: skip
    for name in SEPTA:
        parser.add_argument(
            f"--{name}", type=parse_labels, metavar="LABELS",
            help=f"labels of the {name}, a sheet of dura: part of the brain, fixed; no convention marks it",
        )  # fmt: skip
    parser.add_argument(
        "--regions", type=lambda text: tuple(text.split(",")), default=(), metavar="NAMES",
        help=f"parts marked by the convention that become regions: {', '.join(PART_LABELS)}",
    )  # fmt: skip


def add_axes(parser: argparse._ActionsContainer) -> None:
    """Add the option --axes to a parser, for NIfTI files that do not report their orientation."""
    parser.add_argument(
        "--axes", default="", metavar="RAS",
        help="directions of the axes of NIfTI files with neither sform nor qform, such as RAS or LPS",
    )  # fmt: skip


def parse_labels(text: str) -> tuple[Label, ...]:
    """Parse label numbers and segment names that are separated by commas, for argparse."""
    found = tuple(int(part) if part.strip().isdecimal() else part.strip() for part in text.split(","))
    if "" in found:
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of labels such as 1,2 or Brain,Tumour")
    return found


def parse_sources(args: argparse.Namespace) -> MaskSources:
    """Build the sources of the masks, files and labels, from the options."""
    return MaskSources(
        args.labels,
        args.brain or (),
        args.tumour or (),
        args.convention,
        args.mask,
        args.tumour_in,
        _get_part_labels(args),
        args.axes,
    )


def parse_regions(args: argparse.Namespace) -> tuple[str, ...]:
    """Return the names of the parts of brain and tumour that become regions of the mesh."""
    return tuple(dict.fromkeys((*(name for name in _get_part_labels(args) if name in PART_LABELS), *args.regions)))


def _get_part_labels(args: argparse.Namespace) -> dict[str, tuple[Label, ...]]:
    return {name: getattr(args, name) for name in (*PART_LABELS, *SEPTA) if getattr(args, name) is not None}


def list_label_options(args: argparse.Namespace) -> list[str]:
    """List the names of the given options that require a label volume."""
    names = ("brain", "tumour", "convention", "tumour_in", "axes", *PART_LABELS, *SEPTA, "regions")
    return [f"--{name.replace('_', '-')}" for name in names if getattr(args, name)]


def to_label_args(args: argparse.Namespace) -> list[str]:
    """Return the given label options as command-line arguments of `sulcus anatomy`."""
    given = {
        "--labels": args.labels,
        "--brain": args.brain and ",".join(map(str, args.brain)),
        "--tumour": args.tumour and ",".join(map(str, args.tumour)),
        "--convention": args.convention,
        "--mask": args.mask,
        "--tumour-in": args.tumour_in,
        **{f"--{name}": ",".join(map(str, found)) for name, found in _get_part_labels(args).items()},
        "--regions": ",".join(args.regions) or None,
        "--axes": args.axes or None,
    }
    return [f"{name}={value}" for name, value in given.items() if value is not None]


# Options that place a tumour in the template.
PLACING_OPTIONS = ("radius", "cover", "tumour_shape", "site", "tumour_at", "head", "brain_volume", "falx_depth")
MIN_BRAIN_ML = 20.0  # Smallest accepted volume of a brain [ml].
MAX_BRAIN_ML = 5000.0  # Largest accepted volume of a brain [ml].


def add_synthetic_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of a healthy head and of a synthetic tumour in this head to a parser."""
    drawn = parser.add_argument_group("synthetic tumour in a healthy head, without --labels")
    drawn.add_argument(
        "--head", choices=("template", "fsaverage"),
        help="healthy head: the ICBM template, or fsaverage's inner skull from the package mne (default: template). "
        "For another head give --mask, and --t1 if available",
    )  # fmt: skip
    drawn.add_argument(
        "--brain-volume", type=float, metavar="ML",
        help="volume to which the brain is scaled [ml] (default: 1470; with --mask, its own)",
    )  # fmt: skip
    drawn.add_argument(
        "--radius", type=float, metavar="MM",
        help="radius of the tumour [mm]; if lobed, of a ball of equal volume (default: 12)",
    )  # fmt: skip
    drawn.add_argument(
        "--cover", type=float, metavar="MM", help="distance from the cortex to the top of the tumour [mm] (default: 10)"
    )
    drawn.add_argument("--tumour-shape", choices=("sphere", "lobed"), help="shape of the tumour (default: sphere)")
    drawn.add_argument("--site", choices=tuple(SITES), help="region of the cortex above the tumour (default: central)")
    drawn.add_argument(
        "--tumour-at", type=point, metavar="X,Y,Z", help="centre of the tumour [mm, RAS], instead of --site and --cover"
    )
    drawn.add_argument(
        "--falx-depth", type=float, metavar="MM",
        help="depth of a synthetic falx in the midline, which does not move [mm, 10 to 60] (default: no falx)",
    )  # fmt: skip
    drawn.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the random lobed shape (default: 0)")


def describe_source(args: argparse.Namespace) -> str:
    """Return the name of the source of the brain: a file, a head, or the template."""
    return str(args.labels or args.mask or (args.head if args.head == "fsaverage" else "the template"))


def check_no_synthetic_options(args: argparse.Namespace) -> None:
    """Raise InputError if an option of the synthetic tumour is given, which a label map excludes."""
    for name in PLACING_OPTIONS:
        if getattr(args, name) is not None:
            raise InputError(f"--{name.replace('_', '-')} draws in a healthy head: leave it out with --labels.")


def build_drawn_subject(args: argparse.Namespace, chosen: dict[str, Any]) -> Subject:
    """Build the subject with a synthetic tumour that the options request.

    `chosen` contains lengths [mm], shape and site after application of presets and defaults.

    Raises
    ------
    InputError
        Options contradict each other, a volume is out of range, or the head or the tumour is invalid.
    """
    if args.t1 is not None and args.mask is None:
        raise InputError("--t1 colours your own brain: give --labels or --mask too, or leave it out.")
    if args.mask is not None and args.head is not None:
        raise InputError(f"--mask says whose brain it is, and --head {args.head} does: leave one of them out.")
    if args.brain_volume is not None and not MIN_BRAIN_ML <= args.brain_volume <= MAX_BRAIN_ML:
        raise InputError(
            f"--brain-volume {args.brain_volume:g} is outside {MIN_BRAIN_ML:g} to {MAX_BRAIN_ML:g}: choose between."
        )
    if args.tumour_at is not None and (args.site is not None or args.cover is not None):
        raise InputError("--tumour-at says where the tumour lies: leave out --site and --cover, or --tumour-at.")
    middle = None if args.tumour_at is None else tuple(1e-3 * value for value in args.tumour_at)
    lengths = 1e-3 * chosen["radius"], 1e-3 * chosen["cover"]
    subject = _place_in_head(Tumour(*lengths, chosen["tumour_shape"], chosen["site"], args.seed, middle), args)
    if args.falx_depth is None:
        return subject
    return replace(subject, septa=(synthesise_falx(subject.cortex, 1e-3 * args.falx_depth),))


def _place_in_head(tumour: Tumour, args: argparse.Namespace) -> Subject:
    volume = None if args.brain_volume is None else 1e-6 * args.brain_volume
    if args.mask is not None:
        return build_synthetic_subject(tumour, build_masked_head(args.mask, args.t1, volume))
    head = HeadScaling() if volume is None else HeadScaling(volume)
    if args.head == "fsaverage":
        return build_synthetic_subject(tumour, read_fsaverage_head(head.volume), head)
    return build_template_subject(tumour, head)
