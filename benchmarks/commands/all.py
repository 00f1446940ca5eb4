"""`python -m benchmarks all`: measure all figures of the performance pages, write tables, report what got slower."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from scenes.commands.interrupt import INTERRUPTED_CODE, interrupt_on_termination
from scenes.options.outputs import add_force, check_output_path
from scenes.script.shipped_files import get_template_path
from sim.errors import InputError

from ..figures.figure_record import read_record
from ..figures.figures import NAMED

if TYPE_CHECKING:
    from ..figures.figure_record import Entry, Record

OUT = Path("bench.json")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.epilog = f"figures: {', '.join(NAMED)}"
    parser.add_argument(
        "--json", type=Path, metavar="OUT.json",
        help=f"record, written after every figure; an unfinished run resumes (default: {OUT})",
    )  # fmt: skip
    parser.add_argument(
        "--only", nargs="+", choices=NAMED, default=list(NAMED), metavar="NAME",
        help="figures to measure (default: all; see the names below)",
    )  # fmt: skip
    parser.add_argument("--quick", action="store_true", help="small counts, no record: smoke test of all commands")
    parser.add_argument("--anatomy", type=Path, help="measure on this .vtu instead of the template where a bench can")
    parser.add_argument(
        "--from", dest="source", type=Path, metavar="NEW.json", help="measure nothing: take this record"
    )
    parser.add_argument(
        "--tables", nargs="+", type=Path, default=[], metavar="PAGE.md",
        help="then write the tables between `<!-- bench: NAME ... -->` and `<!-- end -->` of these pages",
    )  # fmt: skip
    parser.add_argument(
        "--against", type=Path, metavar="OLD.json",
        help="then compare with this record, and exit with 1 if a number is worse by more than 10 percent",
    )  # fmt: skip
    add_force(parser)


def run(args: argparse.Namespace) -> int:
    """Measure, write tables, compare; return 1 if a figure failed, missed its target, or got worse."""
    from ..figures.figure_tables import format_table, read_page, write_page

    if args.source and (args.json or args.quick or args.anatomy):
        raise InputError("--from measures nothing: leave out --json, --quick and --anatomy beside it.")
    if args.quick and (args.json or args.tables or args.against):
        raise InputError("--quick keeps no figure: leave out --json, --tables and --against beside it.")
    if args.source and not (args.tables or args.against):
        raise InputError("--from alone does nothing: give --tables or --against with it.")
    old = read_record(args.against) if args.against else None
    for path in args.tables:
        read_page(path)
    try:
        with interrupt_on_termination() as stop_if_asked:
            record = read_record(args.source) if args.source else _measured(args, stop_if_asked)
    except KeyboardInterrupt:
        print(f"stopped; the same command goes on from {args.json or OUT}", file=sys.stderr)
        return INTERRUPTED_CODE
    record = _only(record, args.only)
    code = 0
    if not args.source:
        print(format_table(record.rows))
        code = int(any(entry.state in ("failed", "missed") for entry in record.rows))
    for path in args.tables:
        print(f"{path}: {'written' if write_page(path, record) else 'unchanged'}")
    if old and set(args.only) < set(NAMED):  # for all figures, the comparison also lists removed ones
        old = _only(old, args.only)
    return max(code, _compared(old, record)) if old else code


def _only(record: Record, names: Sequence[str]) -> Record:
    return replace(record, rows=tuple(entry for entry in record.rows if entry.name in names))


def _measured(args: argparse.Namespace, stop_if_asked: Callable[[], None]) -> Record:
    """Measure the requested figures that the record lacks; return the completed record."""
    from sim.bodies.meshfile import read_anatomy

    from ..figures.figure_record import build_record, write_record
    from ..figures.figure_runs import Run, get_code_version, measure_figure

    out = args.json or OUT
    found: dict[str, Entry] = {}
    if not args.quick:
        out = check_output_path(out, ".json", inputs=[args.anatomy, args.against, *args.tables], resumed=True)
        found = {entry.name: entry for entry in _begun(out, args.force)}
    body = read_anatomy(args.anatomy or get_template_path()).digest
    run = Run(get_code_version(), body, args.anatomy, args.quick)
    with tqdm(total=len(args.only), unit="figure", file=sys.stderr) as bar:

        def heard(line: str) -> None:
            stop_if_asked()
            if line:
                bar.write(line, file=sys.stderr)
            elif sys.stderr.isatty():  # updates the elapsed time
                bar.refresh()

        for name in args.only:
            bar.set_description(name)
            before = found.get(name)
            entry = found[name] = measure_figure(NAMED[name], run, before, heard)
            if not args.quick:
                write_record(out, build_record(run.build_origin("auto"), list(found.values())))
            heard(f"{name}: {'kept' if entry is before else entry.state}{entry.reason and ': '}{entry.reason}")
            bar.update()
    return build_record(run.build_origin("auto"), list(found.values()))


def _begun(out: Path, force: bool) -> tuple[Entry, ...]:
    """Read the rows of an unfinished record; with `force`, none if the file is not a record."""
    try:
        return read_record(out).rows if out.exists() else ()
    except InputError:
        if not force:
            raise
        return ()


def _compared(old: Record, new: Record) -> int:
    """Print the changed numbers; return 1 if one got worse or is no longer measured."""
    from ..figures.figure_comparison import MARGIN, compare_records

    found = compare_records(old, new)
    print("| number | old | new | unit | new / old |\n|---|---|---|---|---|")
    print("\n".join(change.table_row for change in found.changes))
    print("", *found.notes, sep="\n")
    for reason in found.lost:
        print(f"no longer measured as before: {reason}")
    for change in found.regressions:
        print(f"worse by more than {MARGIN - 1.0:.0%}: {change.name} ({change.ratio:.2f} times)")
    if not found.regressions and not found.lost:
        print(f"nothing is worse by more than {MARGIN - 1.0:.0%}")
    return int(bool(found.regressions or found.lost))
