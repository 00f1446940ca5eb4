"""`sulcus episodes`: make thousands of scripted episodes with many processes, one file per episode."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Set
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from sim.errors import InputError
from sim.runtime.optional_packages import require_extra

from ..options.outputs import check_output_folder
from ..options.shared_options import add_json, add_seed, to_json_line
from .interrupt import INTERRUPTED_CODE, interrupt_on_termination

if TYPE_CHECKING:
    from ..episodes.engine import ProgressListener, RunStatistics
    from ..episodes.plan import EpisodePlan
    from ..episodes.workers import Workers


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument("plan", metavar="PLAN", help="a plan that ships with sulcus, or your own .toml")
    parser.add_argument("--count", required=True, type=_parse_positive, help="number of episodes")
    add_seed(parser, "all draws", _parse_natural)
    parser.add_argument(
        "--out", required=True, type=Path, metavar="DIR", help="folder of the episodes; an unfinished run is resumed"
    )
    parser.add_argument(
        "--first", type=_parse_natural, default=0, metavar="K", help="number of the first episode (default: 0)"
    )
    who = parser.add_mutually_exclusive_group()
    who.add_argument(
        "--workers", type=_parse_positive, metavar="K",
        help="number of processes on this machine (default: one per core, or per GPU)",
    )  # fmt: skip
    who.add_argument("--scheduler", metavar="ADDRESS", help="the workers of a running Dask scheduler: tcp://HOST:PORT")
    parser.add_argument(
        "--device", choices=("auto", "cpu", "cuda"), default="auto",
        help="compute device. auto: same as earlier runs in this folder, else cuda if available",
    )  # fmt: skip
    parser.add_argument("--again", action="store_true", help="also retry episodes that failed permanently")
    parser.add_argument(
        "--force", action="store_true",
        help="use a folder that contains other files, or that another version of sulcus created",
    )  # fmt: skip
    instead = parser.add_mutually_exclusive_group()
    instead.add_argument(
        "--estimate", action="store_true", help="print the estimated time and disk space only, from earlier runs in DIR"
    )
    instead.add_argument(
        "--slurm",
        type=_parse_positive,
        metavar="MACHINES",
        help="print a script for sbatch with this many machines only",
    )
    add_json(parser)


def _parse_integer(text: str, minimum: int) -> int:
    try:
        number = int(text)
    except ValueError:
        number = minimum - 1
    if number < minimum:
        raise argparse.ArgumentTypeError(f"{text!r:.40} is no whole number from {minimum} on")
    return number


def _parse_positive(text: str) -> int:
    return _parse_integer(text, 1)


def _parse_natural(text: str) -> int:
    return _parse_integer(text, 0)


def _get_plan_path(args: argparse.Namespace) -> str:
    """Return the plan's name, or the absolute path of the plan's file."""
    return str(Path(args.plan).absolute()) if args.plan.endswith(".toml") else args.plan


def run(args: argparse.Namespace) -> int:
    """Make the missing episodes; return 1 if an episode failed, else 0."""
    out = check_output_folder(args.out, "episodes").absolute()
    if args.slurm:
        return _print_script(args, out)
    from ..episodes.plan import load_plan

    plan = load_plan(_get_plan_path(args))  # bodies may be files next to the plan, and workers run elsewhere
    if args.estimate:
        return _print_estimate(args, plan, out)
    try:
        with interrupt_on_termination() as stop_if_asked:
            return _make_episodes(args, plan, out, stop_if_asked)
    except KeyboardInterrupt:
        print(f"stopped; run the same command again to resume in {out}", file=sys.stderr)
        return INTERRUPTED_CODE


def _make_episodes(args: argparse.Namespace, plan: EpisodePlan, out: Path, raise_if_stopped: Callable[[], None]) -> int:
    with require_extra("data", "sulcus episodes needs"):
        from ..episodes.engine import list_missing_episodes, make_episodes
    from ..episodes.make import choose_body, make_body, make_episode
    from ..episodes.run_folder import RunSettings, begin_run, get_versions, list_finished, read_run
    from ..episodes.tasks import RunWork

    before = read_run(out)
    device = before.device if before and args.device == "auto" else args.device
    with _start_workers(args, device) as workers:
        run = RunSettings(plan.name, plan.digest, args.seed, workers.device, get_versions())
        first_client = begin_run(out, run, plan.text, args.force)
        found = list_finished(out)
        there, missing = list_missing_episodes(
            out, found, range(args.first, args.first + args.count), first_client, args.again
        )
        given = out, plan, args.seed
        work = RunWork(
            partial(choose_body, plan, args.seed),
            partial(make_body, *given, device=workers.device),
            partial(make_episode, *given, device=workers.device),
        )
        begun = time.perf_counter()
        with _show_progress(out, there, args.count, raise_if_stopped) as heard:
            tally = make_episodes(work, out, run, missing, workers, heard, there)
        seconds = time.perf_counter() - begun
        changed = tally != there
        lacking = _update_card(out, list_finished(out) if changed else found, changed)
        _report(args, out, tally, seconds, workers.description, lacking is None and tally.made + tally.skipped > 0)
    if lacking is not None:
        print(lacking, file=sys.stderr)
    return int(tally.failed + tally.lost > 0)


def _update_card(folder: Path, numbers: Set[int], has_changes: bool) -> str | None:
    """Update the card of the data set; return the reason if this fails, else None."""
    from tqdm import tqdm

    from ..episodes.exports.card import update_card

    bar = partial(tqdm, unit="episode", desc="data sheet", file=sys.stderr, leave=False, mininterval=1.0, disable=None)
    return update_card(folder, numbers, has_changes, bar)


def _start_workers(args: argparse.Namespace, device: str) -> AbstractContextManager[Workers]:
    from dask.system import CPU_COUNT

    from ..episodes.workers import connect_workers, start_local_workers

    if args.scheduler:
        return connect_workers(args.scheduler, device)
    from sim.runtime.device import find_device, parse_device_names

    if find_device(device, "float32").on_cuda:
        cards = parse_device_names("all")
        count = args.workers or len(cards)
        return start_local_workers([cards[number % len(cards)] for number in range(count)])
    return start_local_workers(["cpu"] * (args.workers or CPU_COUNT))


@contextmanager
def _show_progress(
    folder: Path, statistics: RunStatistics, total: int, raise_if_stopped: Callable[[], None]
) -> Iterator[ProgressListener]:
    """Yield a listener that shows the progress (frames/s, failures), and records task durations in the folder."""
    from tqdm import tqdm

    from ..episodes.engine import BODY
    from ..episodes.rates import write_rates
    from ..episodes.tasks import TaskOutcome

    done, begun = statistics, time.perf_counter()
    pause = 0.5 if sys.stderr.isatty() else 30.0
    words = {
        "total": total, "initial": statistics.skipped + statistics.failed, "unit": "episode", "file": sys.stderr,
        "mininterval": pause, "maxinterval": pause, "smoothing": 0.05,
    }  # fmt: skip
    with write_rates(folder) as written, tqdm(**words) as bar:

        def heard(kind: str, outcome: TaskOutcome | None, workers: int) -> None:
            nonlocal done
            if outcome is None:
                raise_if_stopped()
                bar.set_description(
                    f"{workers} workers" if workers else "waits for workers", refresh=sys.stderr.isatty()
                )
                return
            written(kind, outcome)
            if kind == BODY:
                return
            done = done.add(outcome)
            rate = done.frames / (time.perf_counter() - begun)
            bar.set_postfix_str(f"{rate:.3g} frames/s, {done.failed + done.lost} failed", refresh=False)
            bar.update()

        yield heard


def _report(args: argparse.Namespace, out: Path, tally: RunStatistics, seconds: float, pool: str, card: bool) -> None:
    from ..episodes.bodies import describe_weak, list_model_errors, to_weak_json
    from ..episodes.run_folder import list_failed, read_failure

    count, models = tally.failed + tally.lost, list_model_errors(out)
    if args.json:
        report = {
            "out": str(out),
            "asked": args.count,
            "there": tally.made + tally.skipped,
            "made": tally.made,
            "failed": tally.failed,
            "lost": tally.lost,
            "frames": tally.frames,
            "bytes": tally.bytes,
            "seconds": seconds,
            "where": pool,
            "card": card,
            "bodies_with_a_model": len(models),
            "weak_bodies": to_weak_json(models),
        }
        print(to_json_line(report))
        return
    print(f"{out}: {tally.made + tally.skipped} of {args.count} episodes are there; {tally.made} were made now.")
    if tally.made:
        print(
            f"{tally.frames} frames, {tally.bytes / 1e6:.3g} MB in {seconds:.3g} s by {pool}: "
            f"{tally.made / seconds:.3g} episodes and {tally.frames / seconds:.3g} frames a second."
        )
    print("".join(f"{line}\n" for line in describe_weak(models)), end="")
    if count:
        print(
            f"{count} failed: {out / 'failed'} says why of each. {tally.lost} of them are tried again by the same "
            "command; with --again all are."
        )
        number = min(list_failed(out).intersection(range(args.first, args.first + args.count)), default=0)
        one = read_failure(out, number)
        if one is not None:
            print(f"Episode {number}: {one.reason}")


def _print_estimate(args: argparse.Namespace, plan: EpisodePlan, out: Path) -> int:
    from ..episodes.estimate import compute_estimate, format_estimate
    from ..episodes.rates import read_rates
    from ..episodes.run_folder import read_run

    found = read_run(out)
    if found is not None and found.digest != plan.digest:
        raise InputError(f"{out}: holds episodes of another plan, {found.plan}: choose another folder.")
    bodies = min(args.count, plan.contents.bodies.count)  # sampling a million would take minutes
    estimate = compute_estimate(read_rates(out), args.count, bodies)
    if args.json:
        from dataclasses import asdict

        print(to_json_line(asdict(estimate)))
    else:
        print("\n".join(format_estimate(estimate)))
    return 0


def _print_script(args: argparse.Namespace, out: Path) -> int:
    from ..episodes.engine import write_sbatch_script

    if args.device == "auto":
        raise InputError("--slurm needs to know what its machines have: give --device cpu, or --device cuda.")
    if args.workers or args.scheduler:
        raise InputError("--slurm gives each machine its workers: leave --workers and --scheduler out.")
    words = ["--count", args.count, "--seed", args.seed, "--first", args.first, "--out", out, "--device", args.device]
    command = [sys.executable, "-m", "scenes.cli", "episodes", _get_plan_path(args), *map(str, words)]
    print(write_sbatch_script(command, args.slurm, args.device, f"sulcus-{Path(args.plan).stem}"), end="")
    return 0
