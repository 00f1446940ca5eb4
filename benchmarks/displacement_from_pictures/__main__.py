"""A small network learns from episodes where a tumour went, and is tested on what it has not seen.

    python benchmarks/displacement_from_pictures extract FOLDER --out standard.npz
    python benchmarks/displacement_from_pictures train --train standard.npz --training 400 \
        --test "other bodies=other.npz" --test hard=hard.npz --json found.json

FOLDER is of `sulcus episodes`. Networks are trained on what its trained model says of the tumour's middle, in every
frame, and tested where finite elements say it. They are given the picture, poses as they are tracked, and the force as
it is read: nothing else. Directions are those of the tracked camera's axes.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np

from sim.errors import InputError
from sim.runtime.atomic_files import written_whole


def main(words: list[str] | None = None) -> int:
    """Extract, or train and print tables. 2: files that are not as they should be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    extract = commands.add_parser("extract", help="episodes to one small file")
    extract.add_argument("folder", type=Path)
    extract.add_argument("--out", type=Path, required=True, help=".npz")
    extract.add_argument("--every", type=int, default=10, help="frames from one that is taken to the next (default 10)")
    extract.add_argument("--width", type=int, default=80, help="of reduced pictures (default 80)")
    extract.add_argument("--first", type=int, default=0, help="number of the first episode (default 0)")
    extract.add_argument("--count", type=int, help="episodes from there on (default: all)")
    extract.add_argument("--workers", type=int, default=os.cpu_count(), help="processes (default: one for each core)")
    train = commands.add_parser("train", help="train, test and print")
    train.add_argument("--train", type=Path, nargs="+", required=True, metavar="FILE")
    train.add_argument(
        "--training", type=int, required=True, metavar="K", help="train on the first K; test on the rest"
    )
    train.add_argument("--test", action="append", default=[], metavar="NAME=FILE,...", help="further frames to test on")
    train.add_argument("--sizes", type=int, nargs="*", default=[25, 50, 100, 200], help="fewer training episodes")
    train.add_argument("--seeds", type=int, default=3, help="runs of each (default 3)")
    train.add_argument("--updates", type=int, default=3000, help="most of a network (default 3000)")
    train.add_argument("--batch", type=int, default=256, help="frames of an update (default 256)")
    train.add_argument("--device", default="auto", help="auto, cpu or cuda")
    train.add_argument("--json", type=Path, help="all figures, to this file")
    show = commands.add_parser("show", help="print the tables of such a file again")
    show.add_argument("json", type=Path)
    args = parser.parse_args(words)
    try:
        return {"extract": _extract, "train": _train, "show": _show}[args.command](args)
    except InputError as error:
        print(f"displacement_from_pictures: {error}", file=sys.stderr)
        return 2


def _extract(args: argparse.Namespace) -> int:
    from extraction import extracted
    from frames import write_frames
    from tqdm import tqdm

    frames = extracted(args.folder, args.every, args.width, args.workers, args.first, args.count, tqdm)
    write_frames(args.out, frames)
    size = args.out.stat().st_size / 1e6
    print(
        f"{args.out}: {len(frames)} frames of {len(frames.episodes)} episodes on {len(np.unique(frames.body))} bodies, "
        f"{frames.tested.sum()} of them tested; {size:.1f} MB, {1e3 * size / len(frames):.1f} kB a frame"
    )
    return 0


def _train(args: argparse.Namespace) -> int:
    import torch
    from experiment import rows, sets_of
    from frames import read_frames
    from networks import Training
    from tables import said, tables

    begun = time.perf_counter()
    others = {}
    for each in args.test:
        name, _, files = each.partition("=")
        if not files:
            raise InputError(f"--test {each}: give a name and files, as hard=hard.npz.")
        others[name] = read_frames([Path(file) for file in files.split(",")])
    sets = sets_of(read_frames(args.train), args.training, others)
    name = ("cuda" if torch.cuda.is_available() else "cpu") if args.device == "auto" else args.device
    how = Training(args.updates, args.batch)

    def heard(words: str) -> None:
        print(f"{time.perf_counter() - begun:6.1f} s  {words}", file=sys.stderr, flush=True)

    found = list(rows(sets, args.sizes, range(args.seeds), torch.device(name), how, heard))
    record = said(sets, found, training=asdict(how), seeds=args.seeds, seconds=time.perf_counter() - begun)
    print(tables(record))
    if args.json:
        with written_whole(args.json, ".json") as partial:
            partial.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return 0


def _show(args: argparse.Namespace) -> int:
    from tables import tables

    print(tables(json.loads(args.json.read_text(encoding="utf-8"))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
