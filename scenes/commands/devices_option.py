"""`--device` of commands that work on several devices at once."""

from __future__ import annotations

import argparse


def add_devices(parser: argparse.ArgumentParser, meant: str = "") -> None:
    """Declare it; `meant` says what works there, where that is not the whole command."""
    parser.add_argument(
        "--device",
        default="auto",
        metavar="DEVICES",
        help=f"{meant}auto, cpu or cuda; several with commas between, as in cuda:0,cuda:1, have a process each; all: "
        "every graphics card (default %(default)s)",
    )
