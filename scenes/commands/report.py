"""`sulcus report`: measure accuracy and computing time of every deformer; write a page, plots and tables."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from sim.errors import InputError

from ..options.outputs import add_force, check_output_path
from ..options.shared_options import add_devices, add_json
from .interrupt import INTERRUPTED_CODE

if TYPE_CHECKING:
    from ..report.page import Section
    from ..report.study import ReportStudy

# Numbers of loads of a short and of a full report: simulated where no data are given; compared with the reference;
# beyond the training range.
QUICK_COUNTS, FULL_COUNTS = (256, 8, 12), (3000, 64, 120)
NO_SERIES = "Models of the power series: not measured with --quick on a CPU, where their table takes minutes."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    size = parser.add_mutually_exclusive_group()
    size.add_argument(
        "--quick",
        action="store_true",
        help=f"small report with {QUICK_COUNTS[0]} simulated loads, few comparisons and one mesh: minutes instead of "
        "hours",
    )
    size.add_argument(
        "--full", action="store_true", help="every combination of law, element, mesh, tolerance and precision"
    )
    parser.add_argument("--out", type=Path, default=Path("report"), metavar="DIR", help="output folder")
    add_devices(parser, "; loads are simulated on all, everything else is measured on the first")
    parser.add_argument(
        "--data", nargs="+", type=Path, default=[], metavar="DATA.h5",
        help="data sets from `sulcus simulate`, each in its own rows (default: new: palpation, smoothed elements)",
    )  # fmt: skip
    parser.add_argument(
        "--anatomy",
        metavar="MESH.vtu",
        help="anatomy of the simulated loads if --data is not given (default: the template)",
    )
    parser.add_argument(
        "--loads",
        type=int,
        metavar="N",
        help=f"number of loads compared with the reference (default: {FULL_COUNTS[1]}; with --quick {QUICK_COUNTS[1]})",
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="measure rows by the workers of a running Dask scheduler, tcp://HOST:PORT, that share the output folder",
    )
    parser.add_argument(
        "--seed-protocol",
        action="store_true",
        help="repeat the experiment of Tonutti, Gras, Yang 2017 instead: their loads and learners, one position "
        "left out at a time; other models on the same loads",
    )
    parser.add_argument(
        "--seed-mesh",
        type=Path,
        metavar="FILE.npz",
        help="mesh of Tonutti et al. 2017; --seed-protocol evaluates the models on this mesh, too",
    )
    parser.add_argument(
        "--tissue",
        type=Path,
        metavar="DIR",
        help="compare tissue laws with measured stresses instead: CSV files of one tissue each (docs/notes/tissue.md)",
    )
    parser.add_argument(
        "--credibility",
        type=Path,
        metavar="DIR",
        help="list claims, figures and tests in the order of ASME V&V 40 instead; DIR: a checkout's folder benchmarks",
    )
    add_force(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Measure all rows and write the report; return 1 if a row could not be measured, else 0."""
    if args.tissue:
        return _compare_tissues(args)
    if args.credibility:
        return _assess_credibility(args)
    try:
        sections = _measure_seed_sections(args) if args.seed_protocol else _measure_sections(args)
    except KeyboardInterrupt:
        print(f"stopped; run the same command again to resume from {args.out}", file=sys.stderr)
        return INTERRUPTED_CODE
    _print_sections(args, sections)
    return 0 if all(row.state == "measured" for part in sections for row in part.rows) else 1


def _measure_sections(args: argparse.Namespace) -> list[Section]:
    """Measure the rows of each data set; rewrite the report after each data set."""
    from ..analysis.measurement import describe_machine
    from ..play.effect_record import SUFFIX, read_effect_records
    from ..report.adaptation import build_debulked_study, simulate_debulked
    from ..report.page import Section, write_report
    from ..report.reference import solve_beyond, solve_reference
    from ..report.row import describe_reference_error
    from ..report.rows import (
        connect_scheduler,
        list_all_combinations,
        list_family_specs,
        list_learner_specs,
        list_one_factor_variants,
        measure_on_workers,
        measure_rows,
    )
    from ..report.study import ReportStudy
    from ..script.shipped_files import get_template_path

    device = _check_options(args)
    count, loads, beyond = QUICK_COUNTS if args.quick else FULL_COUNTS
    if args.seed_mesh:
        raise InputError("--seed-mesh belongs to --seed-protocol: give that too, or leave it out.")
    if args.data and args.anatomy:
        raise InputError("--anatomy cannot be combined with --data, which contains an anatomy: leave one of them out.")
    if len({path.stem for path in args.data}) < len(args.data):
        raise InputError("two of the data sets have the same name: rename one.")
    if args.scheduler:
        with connect_scheduler(args.scheduler, "cpu"):  # a wrong address is reported before anything is solved
            pass
    paths = args.data
    if not paths:
        paths = [args.out / "palpation.h5"]
        _simulate_data(paths[0], args, count)
    full = not args.quick
    studies = [ReportStudy(path, args.out, device, args.loads or loads, beyond, thorough=full) for path in paths]
    sections = []
    for study in studies:
        series = full or study.on_card
        specs = (
            *(list_all_combinations(study) if args.full else list_one_factor_variants(study)),
            *list_family_specs(),
            *list_learner_specs(series),
        )
        after = len(study.dataset.loads) + len(study.dataset.unit_good) if full else 0
        total = len(study.test_loads) + len(study.loads_beyond) + after + len(specs)
        found = []
        with tqdm(total=total, desc=study.data.stem, unit="step", file=sys.stderr) as bar:
            solve_reference(study, bar.update)
            solve_beyond(study, bar.update)
            if series:
                _tabulate_series(study, bar)
            if full:
                simulate_debulked(study, bar.update)
                _tabulate_series(build_debulked_study(study), bar)
            for row in (
                measure_on_workers(study, specs, args.scheduler) if args.scheduler else measure_rows(study, specs)
            ):
                found.append(row)
                bar.update()
        effects = read_effect_records(get_template_path().with_suffix(SUFFIX)) if study.is_shipped else {}
        about = [*_describe_study(study), describe_reference_error(full, found), *([] if series else [NO_SERIES])]
        body = study.anatomy.digest, str(study.tissue)
        sections.append(Section(study.data.stem, tuple(about), tuple(found), *body, tuple(effects.values())))
        write_report(args.out, describe_machine(device), sections)
    return sections


def _compare_tissues(args: argparse.Namespace) -> int:
    """Write the comparison with measured tissue, and print R2 of each law in each test."""
    from ..report.tissue import read_measured_tissues, write_tissue_report

    _check_options_without_loads(args, "--tissue", "tissue.json")
    measured = read_measured_tissues(args.tissue)
    fits = write_tissue_report(args.out, measured)
    if args.json:
        print(json.dumps({"page": str(args.out / "index.html"), "fits": [asdict(fit) for fit in fits]}))
        return 0
    for fit in fits:
        agreement = ", ".join(f"{test} {value:.2f}" for test, value in fit.r2.items())
        constants = f"mu {1e-3 * fit.mu:.3g} kPa" + ("" if fit.alpha is None else f", alpha {fit.alpha:.1f}")
        print(f"{fit.measured}: {fit.model + ':':<27} R2 of {agreement}; {constants}")
    print(f"written: {args.out / 'index.html'}")
    return 0


def _assess_credibility(args: argparse.Namespace) -> int:
    """Write the credibility page, and print the number of claims of each status."""
    from ..report.credibility import count_statuses, read_credibility, write_credibility

    _check_options_without_loads(args, "--credibility", "credibility.json")
    rows = read_credibility(args.credibility)
    write_credibility(args.out, rows)
    counts, page = count_statuses(rows), str(args.out / "index.html")
    if args.json:
        print(json.dumps({"page": page, "claims": len(rows), **counts}))
    else:
        words = ", ".join(f"{count} {status}" for status, count in counts.items())
        print(f"{len(rows)} claims: {words}\nwritten: {page}")
    return 0


def _check_options_without_loads(args: argparse.Namespace, option: str, result: str) -> None:
    """Reject options that have no use with `option`, and an output folder without its file `result`."""
    others = args.data, args.anatomy, args.seed_protocol, args.scheduler, args.quick, args.full, args.loads
    if any(others) or (args.tissue and args.credibility):
        raise InputError(f"{option} solves no loads: give only --out, --force and --json with it.")
    check_output_path(args.out / "index.html", ".html", args.force, resumed=(args.out / result).is_file())


def _check_options(args: argparse.Namespace) -> str:
    """Check output path and number of loads; return the device on which rows are measured."""
    from sim.runtime.device import parse_device_names

    several = parse_device_names(args.device)
    check_output_path(args.out / "index.html", ".html", args.force, resumed=(args.out / "rows").is_dir())
    if args.loads is not None and args.loads < 1:
        raise InputError(f"--loads {args.loads} plays nothing: give at least 1.")
    return args.device if len(several) == 1 else several[0]


def _measure_seed_sections(args: argparse.Namespace) -> list[Section]:
    """Measure the published protocol on the authors' mesh (if given) and on the template; return their sections."""
    from ..analysis.measurement import describe_machine
    from ..report import seed_protocol
    from ..report.page import Section, write_report
    from ..report.seed_bodies import make_seed_template, read_seed_mesh
    from .simulate import show_progress

    device = _check_options(args)
    if args.data or args.anatomy or args.scheduler:
        raise InputError("--seed-protocol makes its own data: leave out --data, --anatomy and --scheduler.")
    count, loads = (
        seed_protocol.SEED_COUNTS[not args.quick],
        args.loads or (QUICK_COUNTS if args.quick else FULL_COUNTS)[1],
    )
    bodies = {"authors": read_seed_mesh(args.seed_mesh, count)} if args.seed_mesh else {}
    bodies["template"] = make_seed_template(args.out, count)
    sections = []
    for name, (body, wanted) in bodies.items():
        study = seed_protocol.SeedStudy(args.out / f"seed-{name}.h5", args.out, device, loads)
        with tqdm(desc=name, unit="load", file=sys.stderr) as bar:
            seed_protocol.simulate_seed(study, body, wanted, partial(show_progress, bar))
        rows = seed_protocol.measure_seed_rows(study)
        found = tuple(tqdm(rows, desc=name, total=len(seed_protocol.list_seed_specs()), unit="row", file=sys.stderr))
        sections.append(Section(study.data.stem, seed_protocol.describe_seed_study(study, found), found))
        write_report(args.out, describe_machine(device), sections)
    return sections


def _tabulate_series(study: ReportStudy, progress_bar: tqdm) -> None:
    from ..report.study import tabulate_series

    tabulate_series(study, lambda done, total: progress_bar.set_postfix_str(f"series: {done} of {total} positions"))
    progress_bar.set_postfix_str("")


def _simulate_data(path: Path, args: argparse.Namespace, count: int) -> None:
    """Simulate a data set of `count` loads into a file, or resume an interrupted simulation."""
    from . import simulate

    parser = argparse.ArgumentParser()
    simulate.add_arguments(parser)
    words = ["--out", str(path), "--count", str(count), "--material", "neo-hookean", "--element", "smoothed"]
    asked = parser.parse_args([*([args.anatomy] if args.anatomy else []), *words, "--device", args.device])
    with redirect_stdout(sys.stderr):
        if simulate.run(asked) != 0:
            raise KeyboardInterrupt


def _describe_study(study: ReportStudy) -> tuple[str, ...]:
    from ..report.reference import get_reference
    from ..report.study import KINDS

    truth, preset = get_reference(study), study.dataset.provenance.get("preset", "")
    mesh = "the same mesh with every edge halved" if study.thorough else "the same mesh"
    solver, good = study.reference_accuracy, int(truth.good.sum())
    return (
        f"Data: {len(study.converged)} {preset} loads on {len(study.anatomy.mesh.nodes)} vertices, "
        f"{study.element} elements, {study.tissue}; {study.disc_split.summarise()}.",
        f"Reference: quadratic tetrahedra (p2) on {mesh}, the data's tissue, to {solver.tolerance:g} in "
        f"{solver.precision}, read at the same material points. {good} of {len(truth.good)} loads of the left-out "
        f"discs converged, {truth.seconds.mean():.2g} s each. Beyond the training range, in equal parts: "
        f"{', '.join(KINDS)}.",
    )


def _print_sections(args: argparse.Namespace, sections: Sequence[Section]) -> None:
    page = args.out / "index.html"
    if args.json:
        print(json.dumps({"page": str(page), "sections": [asdict(section) for section in sections]}))
        return
    for section in sections:
        figures = "mean, mean of each load's worst vertex, largest"
        print(f"{section.name}: distance from the reference [mm]: {figures}; median time a load [ms]")
        width = max((len(row.name) for row in section.rows), default=0)
        for row in section.rows:
            if row.reference is None or row.median is None:
                print(f"  {row.name:<{width}} {row.state}")
                continue
            mm, worst = row.reference.mm, row.reference.worst
            distances = f"{mm.mean:8.4f} {worst.mean:8.4f} {mm.largest:8.4f}"
            print(f"  {row.name:<{width}} {distances} {row.median:10.3g}  {row.against}")
    print(f"written: {page}")
