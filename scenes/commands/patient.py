"""`sulcus patient`: build anatomy, training data and models from a label volume."""

import argparse
import json
import shlex
import sys
import time
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

from sim.anatomy import BRAIN_LABEL, PART_LABELS, REGION_NAMES, TUMOUR_LABEL
from sim.bodies.head_masks import read_head_masks
from sim.bodies.intensity import encode_intensity
from sim.bodies.label_volume import build_masked_subject
from sim.bodies.meshfile import read_anatomy
from sim.bodies.sample_head import build_sample_head
from sim.bodies.subject import MeshPlan, choose_diameter, find_exposed_cortex
from sim.elements import RECOMMENDED
from sim.errors import InputError
from sim.material import BRAIN, LAWS, Tissue, build_law
from sim.runtime.atomic_files import write_atomically
from sim.runtime.journal import open_journal
from sim.runtime.partial_files import to_unfinished_path
from sim.runtime.timing import listen_to_stages
from surrogate.data.splits import CALIBRATION_STRIDE, DiscSettings
from surrogate.data.tool_loads import PRESETS

from ..options.outputs import add_force, check_output_path
from ..options.placement_options import (
    add_craniotomy_arguments,
    get_trajectory_path,
    place_craniotomy,
    to_craniotomy_args,
    to_metres,
)
from ..options.shared_options import add_devices, add_json
from ..options.subject_options import add_label_options, list_label_options, parse_regions, parse_sources, to_label_args
from ..options.tissue_options import NON_BRAIN_REGIONS, add_element_argument, add_region_argument, parse_region_tissues
from ..script.shipped_files import get_template_path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument("labels", nargs="?", type=Path, metavar="LABELS.nii.gz", help="label volume")
    parser.add_argument(
        "--sample", action="store_true",
        help="without LABELS: write sample_labels.nii.gz and sample_t1.nii.gz of a synthetic patient next to --out, "
        "and continue with them",
    )  # fmt: skip
    add_label_options(parser, "--convention", "--labels")
    parser.add_argument("--t1", type=Path, help="intensities in the same space, for the camera view")
    parser.add_argument(
        "--out", type=Path, default="patient.vtu", metavar="PATIENT.vtu",
        help="anatomy to write; data (.h5) and models (.model.npz) are written next to it",
    )  # fmt: skip
    add_craniotomy_arguments(parser)
    parser.add_argument(
        "--inspect", action="store_true",
        help="only check the input, in seconds: numbers, warnings, and PATIENT.inspect.png; no anatomy is built",
    )  # fmt: skip
    parser.add_argument("--count", type=int, default=1000, help="number of loads to simulate")
    parser.add_argument(
        "--tool-preset", choices=PRESETS, default="palpation",
        help="tool preset; mixed: all tools; seed: the published protocol; brutal: far beyond surgical loads"
    )  # fmt: skip
    parser.add_argument("--material", choices=LAWS, default=BRAIN.law, help="tissue law")
    add_region_argument(parser)
    add_element_argument(parser)
    parser.add_argument(
        "--learners", default="linear,series,series-gp",
        help="model types, see `sulcus train --help`, separated by commas",
    )  # fmt: skip
    add_devices(parser, "; loads are simulated on all, models trained on the first")
    add_force(parser)
    add_json(parser, "a JSON line of each step, then one of the seconds")


def run(args: argparse.Namespace) -> int:
    """Run the commands anatomy, simulate and train; return the exit code. The same call resumes an interrupted run."""
    # Report problems now, not after minutes of reading and meshing.
    _check_source(args)
    plan = MeshPlan(args.nodes, to_metres(args.craniotomy), fine_opening=args.fine_opening)
    regions = parse_region_tissues(args.region, build_law(args.material, BRAIN.young, BRAIN.poisson))
    strange = set(regions) - set(REGION_NAMES.values())
    if strange:
        raise InputError(
            f"--region {min(strange)}: a patient has no such region. Choose from {', '.join(NON_BRAIN_REGIONS)}."
        )
    # A part of another stiffness must be a region.
    args.regions = (*args.regions, *(name for name, label in PART_LABELS.items() if label in regions))
    note = to_unfinished_path(args.out)
    resumed = note.exists() and not args.force
    check_output_path(args.out, ".vtu", args.force, _list_inputs(args), resumed or args.inspect)
    if args.inspect:
        return _show_preview(args, plan, regions)
    from sim.runtime.device import parse_device_names
    from surrogate.training.train import check_learner_names

    from ..cli import main
    from ..play.deformers import to_model_path
    from .train import parse_learners

    data, model = args.out.with_suffix(".h5"), to_model_path(args.out)
    for path, suffix in ((data, ".h5"), (model, ".npz")):
        check_output_path(path, suffix, args.force, _list_inputs(args), resumed)
    parse_device_names(args.device)
    check_learner_names(parse_learners(args.learners), has_poses=False, source=str(data))
    if args.count - args.count // CALIBRATION_STRIDE < DiscSettings.min_discs + 1:
        raise InputError(
            f"--count {args.count} is too few to learn from and to leave {DiscSettings.min_discs} discs out: give more."
        )
    force = ["--force"] if args.force else []
    t1 = [] if args.t1 is None else ["--t1", str(args.t1)]
    steps = [
        ["anatomy", *to_label_args(args), *t1, *to_craniotomy_args(args), "--out", str(args.out)],
        ["simulate", str(args.out), "--out", str(data), "--count", str(args.count), "--tool-preset", args.tool_preset,
         "--device", args.device, "--material", args.material,
         *([] if args.element is None else ["--element", args.element]),
         *(f"--region={text}" for text in args.region)],
        ["train", str(data), "--out", str(model), "--learners", args.learners, "--device", args.device],
    ]  # fmt: skip
    began = time.perf_counter()
    if args.sample:
        _write_sample(args)
    if args.force:
        note.unlink(missing_ok=True)
    changed = [path.stat().st_mtime for path in _list_inputs(args) if path.exists()]
    begun = {"anatomy": shlex.join(steps[0]), "inputs": f"of {datetime.fromtimestamp(max(changed, default=0))}"}
    with listen_to_stages() as seconds, open_journal(note, begun) as journal:
        try:
            for step in steps:
                if (step[0], 0) in journal:
                    continue
                if not args.json:
                    print(f"sulcus {' '.join(step)}", flush=True)
                code = main([*step, *force, "--json"] if args.json else [*step, *force])
                if code != 0:
                    return code
                journal.add((step[0], 0), b"")
        finally:
            if ("anatomy", 0) not in journal or ("train", 0) in journal:
                note.unlink()
    whole = time.perf_counter() - began
    # Imports, checks and figures: what no stage claims.
    seconds["rest"] = whole - sum(seconds.values())
    if args.json:
        print(json.dumps({"anatomy": str(args.out), "model": str(model), "seconds": seconds, "total": whole}))
    else:
        print(f"{_format_shares(seconds, whole)}\nready: sulcus demo --anatomy {args.out}{_format_scene_options(args)}")
        print(
            f"for the error of the tumour: sulcus uncertainty press --anatomy {args.out}{_format_scene_options(args)}"
        )
    return 0


def _check_source(args: argparse.Namespace) -> None:
    """Check that there is one source of labels; for --sample, set its files and labels in `args`."""
    if not args.sample:
        if args.labels is None:
            raise InputError("no label map: give LABELS.nii.gz, or --sample for a synthetic patient.")
        return
    for given in (*_list_inputs(args), *list_label_options(args)):
        raise InputError(f"--sample brings its own labels and T1: leave out {given}, or --sample.")
    args.labels, args.t1 = (args.out.parent / f"sample_{name}.nii.gz" for name in ("labels", "t1"))
    args.brain, args.tumour = (BRAIN_LABEL,), (TUMOUR_LABEL,)


def _write_sample(args: argparse.Namespace) -> None:
    """Write label map and T1 scan of --sample; keep equal files, so that a run can be resumed."""
    volumes, new = build_sample_head(read_anatomy(get_template_path()).mesh), {}
    for path, data in zip((args.labels, args.t1), map(encode_intensity, volumes), strict=True):
        if not (path.is_file() and path.stat().st_size == len(data) and path.read_bytes() == data):
            new[check_output_path(path, ".gz", args.force)] = data
    for path, data in new.items():
        with write_atomically(path, ".gz") as partial:
            partial.write_bytes(data)
    shown = f"sample label map: {args.labels} (1 brain, 2 tumour)\nsample T1: {args.t1}"
    print(shown, file=sys.stderr if args.json else sys.stdout, flush=True)


def _list_inputs(args: argparse.Namespace) -> list[Path]:
    return [path for path in (args.labels, args.mask, args.tumour_in, args.t1) if path is not None]


def _show_preview(args: argparse.Namespace, plan: MeshPlan, regions: Mapping[int, Tissue]) -> int:
    """Print and draw a preview of the anatomy that would be built; return 0."""
    from ar.screen import write_png

    from .inspection import inspect_subject
    from .inspection_sheet import draw_sheet

    began = time.perf_counter()
    picture = args.out.with_suffix(".inspect.png")
    check_output_path(picture, ".png", True, _list_inputs(args))  # an earlier preview is replaced
    if args.sample:
        _write_sample(args)
    masks = read_head_masks(parse_sources(args))
    subject = place_craniotomy(build_masked_subject(masks, args.t1, regions=parse_regions(args)), args)
    found = inspect_subject(masks, subject, regions)
    opened = find_exposed_cortex(subject, choose_diameter(subject, plan))
    with write_atomically(picture, ".png") as partial:
        write_png(partial, draw_sheet(found, masks, subject, opened))
    took = round(time.perf_counter() - began, 2)
    if args.json:
        print(json.dumps({**found.to_json(), "picture": str(picture), "seconds": took}))
    else:
        warnings = [f"  - {warning}" for warning in found.warnings]
        print("\n".join([*found.format_lines(), *(["warnings:", *warnings] if warnings else ["no warnings"])]))
        print(f"drawn to {picture} in {took} s; without --inspect the models are made")
    return 0


def _format_scene_options(args: argparse.Namespace) -> str:
    """Return the options (text) with which a scene matches these data: tissue, element and planned trajectory."""
    tissue = "" if args.material == BRAIN.law else f" --material {args.material}"
    element = "" if args.element in (None, RECOMMENDED) else f" --element {args.element}"
    trajectory = get_trajectory_path(args)
    return tissue + element + ("" if trajectory is None else f" --trajectory {trajectory}")


def _format_shares(seconds: Mapping[str, float], total: float) -> str:
    rows = [f"  {name:<16}{took:8.1f} s{100.0 * took / total:6.1f} %" for name, took in seconds.items()]
    return "\n".join([f"label volume to surrogate in {total:.1f} s:", *rows])
