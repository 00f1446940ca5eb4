"""`sulcus convert`: convert episodes to other data formats, or write the card of a data set."""

import argparse
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from sim.errors import InputError
from sim.runtime.optional_packages import require_extra

from ..options.outputs import add_force, check_output_path
from ..options.shared_options import add_json, to_json_line

FORMATS = ("lerobot", "robomimic", "folder", "xdmf", "card")  # Names of the formats.


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument("episodes", nargs="+", type=Path, help="folder of episodes, or episode files (.h5)")
    parser.add_argument(
        "--to",
        required=True,
        choices=FORMATS,
        help="output format: LeRobot v3.0, robomimic (.hdf5), images and tables, XDMF for ParaView, or a dataset card",
    )
    parser.add_argument("--out", type=Path, help="new folder or .hdf5 file; not for `--to card`")
    add_force(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Read the episodes, and write them in the requested format, atomically; return 0.

    Raises
    ------
    InputError
        Episodes are missing or incomplete, or cannot be in one data set; the output cannot be written.
    """
    from tqdm import tqdm

    from ..episodes.reading.contents import read_contents
    from ..episodes.reading.windows import list_episode_paths

    write = build_episode_writer(args)
    contents = [read_contents(path) for path in list_episode_paths(args.episodes)]
    report = write(contents, progress=partial(tqdm, unit="episode", file=sys.stderr))
    summary = f"{len(contents)} episodes written to {report['out']}"
    if args.to == "card":
        summary = f"card of {len(contents)} episodes written to {report['out']}: {', '.join(report['files'])}"
    if report.get("points_only"):
        summary += f"; the surfaces of {report['points_only']} are not known, so that they hold points alone"
    print(to_json_line(report) if args.json else summary)
    return 0


def build_episode_writer(args: argparse.Namespace) -> Callable[..., dict[str, Any]]:
    """Check the output path, and return the function that writes episodes in the requested format.

    Raises
    ------
    InputError
        The output is not given or exists, or a package is missing.
    """
    if args.to == "card":
        from ..episodes.exports.card import write_card

        if len(args.episodes) != 1 or not args.episodes[0].is_dir():
            raise InputError("--to card: name the folder of the data set; its card is written into it.")
        if args.out is not None:
            raise InputError("--out: a card lies in the data set itself. Leave --out away.")
        return lambda contents, progress: write_card(args.episodes[0], contents, progress, args.force)
    if args.out is None:
        raise InputError(f"--to {args.to}: say where to by --out.")
    if args.to == "robomimic":
        from ..episodes.exports.robomimic import write_robomimic

        out = check_output_path(args.out, ".hdf5", args.force, args.episodes)
        return partial(write_robomimic, path=out)
    return partial(find_folder_writer(args.to), folder=args.out)


def find_folder_writer(name: str) -> Callable[..., dict[str, Any]]:
    """Return the function that writes a folder of episodes in the format `name`.

    Raises
    ------
    InputError
        The package that writes LeRobot's tables is missing.
    """
    if name == "lerobot":
        with require_extra("data", "--to lerobot needs"):
            from ..episodes.exports.lerobot import write_lerobot
        return write_lerobot
    if name == "folder":
        from ..episodes.exports.plain_folder import write_folder

        return write_folder
    from ..episodes.exports.xdmf import write_xdmf

    return write_xdmf
