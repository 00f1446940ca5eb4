"""Options that most commands have: `--anatomy`, `--device`, `--seed` and `--json`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path


def add_anatomy(parser: argparse.ArgumentParser) -> None:
    """Declare `--anatomy`; None stands for the template."""
    parser.add_argument("--anatomy", type=Path, help=".vtu made by `sulcus anatomy` (default: the template that ships)")


def add_device(parser: argparse.ArgumentParser, purpose: str = "") -> None:
    """Declare `--device` of one device; `purpose` is what works there, where that is not all of the command."""
    parser.add_argument(
        "--device", default="auto", help=f"auto, cpu, cuda or cuda:1{purpose and f', for {purpose}'} (default auto)"
    )


def add_devices(parser: argparse.ArgumentParser, meant: str = "") -> None:
    """Declare `--device` of several devices; `meant` is a sentence before, where not the whole command works there."""
    parser.add_argument(
        "--device",
        default="auto",
        metavar="DEVICES",
        help=f"{meant}auto, cpu or cuda. Several with commas between, as in cuda:0,cuda:1, have a process each. all: "
        "every graphics card. Default: %(default)s",
    )


def add_seed(
    parser: argparse.ArgumentParser, purpose: str = "the random draw", kind: Callable[[str], int] = int
) -> None:
    """Declare `--seed` of a `purpose`, read as `kind`."""
    parser.add_argument("--seed", type=kind, default=0, help=f"seed of {purpose} (default %(default)s)")


def add_json(parser: argparse.ArgumentParser, meaning: str = "print one JSON line in place of the text") -> None:
    """Declare `--json`."""
    parser.add_argument("--json", action="store_true", help=meaning)
