"""`sulcus train`: fit models to a data set, and compare their errors on held-out discs of the cortex."""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
from tqdm import tqdm

from sim.errors import InputError
from sim.runtime.device import parse_device_names
from sim.runtime.partial_files import to_unfinished_path
from sim.runtime.timing import time_stage
from surrogate.data.dataset import Dataset, read_dataset
from surrogate.data.splits import CALIBRATION_STRIDE
from surrogate.data.tool_loads import compute_rejected_share, describe_rejected_loads
from surrogate.evaluation.score import find_best_score, format_scores
from surrogate.model.guarded import describe_error, get_reported_errors
from surrogate.model.learned import Learned
from surrogate.model.store import save
from surrogate.training.expansion import SERIES_MODELS, Expansion
from surrogate.training.train import LEARNERS, MIN_CALIBRATION_LOADS, POSE_LEARNERS, Trained, list_learners, train

from ..options.outputs import add_force, check_output_path
from ..options.shared_options import add_devices, add_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument("data", metavar="DATA.h5", help="data set from `sulcus simulate`")
    parser.add_argument("--out", required=True, metavar="MODEL.npz", help="output file of all models")
    parser.add_argument(
        "--learners",
        help=f"model types: {', '.join(LEARNERS)}, or for poses {', '.join(POSE_LEARNERS)}, separated by commas "
        "(default: all that the data can train)",
    )
    parser.add_argument("--most", type=int, metavar="LOADS", help="maximum number of training loads (default: all)")
    add_devices(parser, "; the power series is computed by FEM on the first")
    add_force(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Train the models, compare them on held-out loads, and write them to a file; return 0."""
    out = check_output_path(args.out, ".npz", args.force)
    device = parse_device_names(args.device)[0]
    if args.force:
        to_unfinished_path(out).unlink(missing_ok=True)
    asked = None if args.learners is None else parse_learners(args.learners)
    with time_stage("read the data"):
        data = read_dataset(args.data)
    learners = asked or list(list_learners(data))
    for note in list_notes(data, learners):
        print(f"sulcus train: {note}", file=sys.stderr)
    # No estimate of the remaining time: learners differ between seconds and minutes.
    shown = "{l_bar}{bar}| {n_fmt}/{total_fmt} learners [{elapsed}{postfix}]"
    with tqdm(total=len(learners), bar_format=shown, disable=args.json, file=sys.stderr) as bar:
        expansion = Expansion(
            data,
            device,
            lambda done, total: bar.set_postfix_str(f"series: {done} of {total} positions"),
            journal_path=to_unfinished_path(out),
        )
        trained = train(data, learners, lambda learner: bar.update(), most=args.most, expansion=expansion)
    with time_stage("save"):
        save(out, trained.models)
        to_unfinished_path(out).unlink(missing_ok=True)
    failed = int(np.sum(~data.good))
    preset = "" if data.tool is not None else data.provenance.get("preset", "")
    show = _format_json if args.json else _format_text
    print(show(trained, args.out, failed, preset))
    return 0


def parse_learners(text: str) -> list[str]:
    """Parse the names in --learners; raise InputError if a name is empty."""
    names = [name.strip() for name in text.split(",")]
    if not all(names):
        raise InputError(f"--learners {text!r}: name each learner, with one comma between two, or leave it out.")
    return names


def list_notes(data: Dataset, learners: Sequence[str]) -> list[str]:
    """List notes as sentences on slow computations and on results that would need more loads."""
    notes, good = [], int(data.good.sum())
    expanded = [name for name in learners if name in SERIES_MODELS]
    if expanded:
        notes.append(
            f"{' and '.join(expanded)} first compute a table by FEM, which takes minutes on a CPU; "
            "the bar counts its contact positions."
        )
    if good // CALIBRATION_STRIDE < MIN_CALIBRATION_LOADS:
        notes.append(
            f"of {good} loads {good // CALIBRATION_STRIDE} calibrate error bounds; at least {MIN_CALIBRATION_LOADS} "
            "are needed: the models will have one bound for all loads instead of one for each. "
            f"`sulcus simulate --count {CALIBRATION_STRIDE * MIN_CALIBRATION_LOADS}` gives enough."
        )
    return notes


def _format_text(trained: Trained, out: str, failed_count: int, preset: str) -> str:
    notes = [f"{failed_count} unreliable solutions were excluded."] if failed_count else []
    notes += [words for words in [describe_rejected_loads(preset)] if words]
    bounds = ", ".join(f"{name} {1e3 * model.bound:.3f}" for name, model in trained.models.items())
    return "\n".join(
        [
            *notes,
            trained.split.summarise(),
            "error at the tumour's vertices on the held-out loads, relative to FEM on the same mesh:",
            format_scores(trained.scores, 1e3 * trained.motion),
            f"95th percentile of the maximum vertex error on held-out loads [mm]: {bounds}; scenes use the smallest",
            *(f"on those discs, {name}: {describe_error(model)}" for name, model in trained.models.items()),
            *(f"on those discs, bounds of {name} cover {found}" for name, found in trained.held_out_coverage.items()),
            *(
                f"on those discs, bounds of the distance from tip to tumour by {name} cover {found}"
                for name, found in trained.held_out_distance_coverage.items()
            ),
            *(f"on those discs, the tool's force by {name}: {found}" for name, found in trained.force.items()),
            f"the models written were trained on {trained.training_loads} loads; {_describe_calibration(trained)}",
            f"written: {out}",
        ]
    )


def _describe_calibration(trained: Trained) -> str:
    if trained.calibrated < MIN_CALIBRATION_LOADS:
        few = f"{trained.calibrated} other loads are too few to calibrate a bound for each load"
        return f"{few}: images show the maximum vertex error above for every load, which is not calibrated"
    return f"{trained.calibrated} other loads calibrated the bounds"


def _describe_error(model: Learned) -> dict[str, object]:
    """Return the errors that a model reports, for JSON."""
    reported = get_reported_errors(model)
    discs = None if reported.held_out is None else asdict(reported.held_out)
    return {"bound_mm": 1e3 * reported.bound, "discs": discs, "weak": reported.is_weak}


def _format_json(trained: Trained, out: str, failed_count: int, preset: str) -> str:
    split = trained.split
    return json.dumps(
        {
            "out": out,
            "scores": [{**asdict(row), **_describe_error(trained.models[row.name])} for row in trained.scores],
            "winner": find_best_score(trained.scores).name,
            "motion_mm": 1e3 * trained.motion,
            "discs": len(split.centres),
            "disc_radius_mm": 1e3 * split.radius,
            "share_of_patch": split.area_share,
            "training_loads": int(split.training_mask.sum()),
            "held_out": int(split.test_mask.sum()),
            "calibrated": trained.calibrated,
            "left_out": {name: asdict(found) for name, found in trained.held_out_coverage.items()},
            "distance_left_out": {name: asdict(found) for name, found in trained.held_out_distance_coverage.items()},
            "force": {name: asdict(found) for name, found in trained.force.items()},
            "not_converged": failed_count,
            "nominal_refused": compute_rejected_share(preset),
        }
    )
