"""`--device` of commands that work on several devices at once."""

from __future__ import annotations

import argparse


def add_devices(parser: argparse.ArgumentParser, meant: str = "") -> None:
    """Declare it; `meant` is a sentence before, where the whole command does not work there."""
    parser.add_argument(
        "--device",
        default="auto",
        metavar="DEVICES",
        help=f"{meant}auto, cpu or cuda. Several with commas between, as in cuda:0,cuda:1, have a process each. all: "
        "every graphics card. Default: %(default)s",
    )
