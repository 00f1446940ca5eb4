"""`sulcus validate`: check that episodes are complete, and list their faults."""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from ..options.shared_options import add_device, add_json, to_json_line

if TYPE_CHECKING:
    from ..episodes.reading.validation import Report

MAX_LISTED_FILES = 50  # Maximum number of files that are listed one by one.


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument("episodes", nargs="+", type=Path, help="folders of episodes, or episode files (.h5)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="number of processes")
    parser.add_argument(
        "--solve", type=int, default=0, metavar="K", help="number of frames of each episode to solve again"
    )
    add_device(parser, "--solve")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Validate each episode file, and report the faults; return 1 if a file has faults, else 0.

    Raises
    ------
    InputError
        There are no files to check.
    """
    from tqdm import tqdm

    from sim.errors import InputError

    from ..episodes.bodies import describe_weak, list_model_errors, to_weak_json
    from ..episodes.reading.repeated_frames import validate_files
    from ..episodes.reading.windows import list_episode_paths

    if args.workers < 1:
        raise InputError(f"--workers {args.workers}: at least one process must look.")
    if args.solve < 0:
        raise InputError(f"--solve {args.solve}: give a number of frames, or leave it away.")
    paths = list_episode_paths(args.episodes)
    with tqdm(total=len(paths), unit="episode", file=sys.stderr) as bar:
        found = {}
        for report in validate_files(paths, min(args.workers, len(paths))):
            found[report.path] = report
            bar.update()
    reports = [found[path] for path in dict.fromkeys(paths)]
    reports += [one for place in args.episodes if place.is_dir() for one in list_missing_episodes(place)]
    if args.solve:
        from ..episodes.reading.repeated_frames import solve_frames_again

        bar = tqdm(reports, unit="episode", desc="solved again", file=sys.stderr)
        reports = [one if one.problems else solve_frames_again(one, args.solve, args.device) for one in bar]
    broken = [report for report in reports if report.problems]
    trained = {place: list_model_errors(place) for place in args.episodes if place.is_dir()}
    if args.json:
        files = [{**asdict(one), "path": str(one.path)} for one in reports]
        weak = {str(place): to_weak_json(models) for place, models in trained.items()}
        print(to_json_line({"episodes": len(reports), "broken": len(broken), "files": files, "weak_bodies": weak}))
    else:
        lines = format_reports(reports, broken)
        for place, models in trained.items():
            lines += [line if line.startswith("-") else f"{place}: {line}" for line in describe_weak(models)]
        print("\n".join(lines))
    return 1 if broken else 0


def list_missing_episodes(folder: Path) -> list[Report]:
    """Return a report for each episode that the card of a folder lists and that is missing."""
    from ..episodes.exports.card import TABLE, list_card_files
    from ..episodes.reading.validation import Report

    words = f"is gone; {TABLE} lists it. Make it again, or write the card again: `sulcus convert FOLDER --to card`."
    return [Report(folder / name, [words]) for name in list_card_files(folder) if not (folder / name).is_file()]


def format_reports(reports: list[Report], unreadable: list[Report]) -> list[str]:
    """Format faults of each file, skipped checks, and statistics of all complete episodes as text lines."""
    lines = [f"{report.path}: {problem}" for report in unreadable for problem in report.problems]
    lines = [
        *lines[:MAX_LISTED_FILES],
        *([f"and {len(lines) - MAX_LISTED_FILES} more: --json has all"] if len(lines) > MAX_LISTED_FILES else []),
    ]
    skipped: dict[str, int] = {}
    for report in reports:
        for one in report.skipped:
            skipped[one] = skipped.get(one, 0) + 1
    lines += [f"not looked at in {count} of {len(reports)} episodes: {one}" for one, count in skipped.items()]
    whole = [report for report in reports if not report.problems]
    counts = ("frames", "solved", "unsolved")
    frames, solved, unsolved = (sum(getattr(report, name) for report in whole) for name in counts)
    lines.append(
        f"{len(whole)} of {len(reports)} episodes are whole: {frames} frames, {solved} of them solved "
        f"by finite elements, {unsolved} without convergence"
    )
    errors = [one.error_mm for one in whole if one.error_mm is not None]
    if errors:
        mean, worst = sum(one[0] for one in errors) / len(errors), max(one[1] for one in errors)
        lines.append(f"predicted tumour, relative to finite elements: mean {mean:#.3g} mm, maximum {worst:#.3g} mm")
    again = [one for one in reports if one.again_mm is not None]
    if again:
        lines.append(
            f"{sum(one.again for one in again)} frames solved again lie at most "
            f"{max(one.again_mm or 0.0 for one in again):.4f} mm from where the files have them"
        )
    return lines
