"""`python -m benchmarks published`: the published learners under the published test."""

import argparse
import json
import sys
import time
from dataclasses import asdict

import numpy as np
from tqdm import tqdm

from scenes.options.shared_options import add_json
from surrogate.data.dataset import read_dataset
from surrogate.evaluation.score import format_scores, score

from ..published.models import MACHINES, published_nodes
from ..published.protocol import positions_of, trained_in_turn


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("data", metavar="DATA.h5", help="from `sulcus simulate --tool-preset seed`")
    parser.add_argument("--learners", nargs="+", default=list(MACHINES), choices=MACHINES, help="which (default: all)")
    parser.add_argument("--count", type=int, help="use the first so many loads only")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Train each learner once for every position left out, and score them on the loads there."""
    data = read_dataset(args.data)
    good = np.flatnonzero(data.good)[: args.count]
    loads, nodes = data.loads.select(good), published_nodes(data.anatomy)
    truth = data.read_displacement(nodes)[good]
    sites, scores, seconds = positions_of(loads), [], []
    for name in args.learners:
        begun = time.perf_counter()
        total = len(sites) * len(nodes)
        with tqdm(total=total, desc=name, unit="vertex", disable=args.json, file=sys.stderr) as bar:
            model = trained_in_turn(name, data.anatomy, loads, truth, bar.update)
        seconds.append(time.perf_counter() - begun)
        scores.append(score(name.removeprefix("published-"), model, loads, truth, nodes))
    motion = 1e3 * float(np.linalg.norm(truth, axis=2).mean())
    if args.json:
        rows = [{**asdict(row), "seconds": spent} for row, spent in zip(scores, seconds, strict=True)]
        sizes = {"loads": len(loads), "positions": len(sites), "vertices": len(nodes)}
        print(json.dumps({"rows": rows, "motion_mm": motion, **sizes}))
        return 0
    print(f"{len(loads)} loads, each answered without its position, at {len(nodes)} vertices of the tumour:")
    print(format_scores(scores, motion))
    print("training [s]: " + ", ".join(f"{row.name} {spent:.0f}" for row, spent in zip(scores, seconds, strict=True)))
    return 0
