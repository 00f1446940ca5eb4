"""`sulcus patient`: from a label volume to a brain that the scenes can play, in one go."""

from __future__ import annotations

import argparse
from pathlib import Path

from sim.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("labels", type=Path, metavar="LABELS.nii.gz", help="label volume")
    parser.add_argument("--brain", required=True, help="labels that are brain, separated by commas")
    parser.add_argument("--tumour", required=True, help="labels that are tumour, separated by commas")
    parser.add_argument("--t1", type=Path, help="intensities in the same space, for the camera view")
    parser.add_argument("--out", required=True, type=Path, help="the anatomy, PATIENT.vtu; all else is put beside it")
    parser.add_argument("--nodes", default="5300", help="mesh nodes (default %(default)s)")
    parser.add_argument("--craniotomy", default="50", help="diameter [mm] (default %(default)s)")
    parser.add_argument("--count", default="1000", help="loads to simulate (default %(default)s)")
    parser.add_argument("--preset", default="palpation", help="the tool (default %(default)s)")
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda")


def run(args: argparse.Namespace) -> int:
    """Run anatomy, simulate and train; an interrupted run goes on when the same command is given again."""
    from ..cli import main
    from ..theatre import model_path

    if args.out.suffix != ".vtu":
        raise InputError(f"{args.out}: the anatomy is written as .vtu; give a name that ends so.")
    data, model = args.out.with_suffix(".h5"), model_path(args.out)
    t1 = [] if args.t1 is None else ["--t1", str(args.t1)]
    steps = [
        ["anatomy", "--labels", str(args.labels), "--brain", args.brain, "--tumour", args.tumour, *t1,
         "--nodes", args.nodes, "--craniotomy", args.craniotomy, "--out", str(args.out)],
        ["simulate", str(args.out), "--out", str(data), "--count", args.count, "--preset", args.preset,
         "--device", args.device],
        ["train", str(data), "--out", str(model)],
    ]  # fmt: skip
    for step in steps:
        print(f"sulcus {' '.join(step)}", flush=True)
        code = main(step)
        if code != 0:
            return code
    print(f"ready: sulcus demo --anatomy {args.out}")
    return 0
