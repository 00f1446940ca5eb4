"""Command-line options that many commands share, such as --anatomy, --device and --json, and JSON output."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim.errors import InputError

if TYPE_CHECKING:
    from ar.overlay.styles import Style
    from ar.page.browser import Browser


def add_anatomy(parser: argparse.ArgumentParser) -> None:
    """Add the option --anatomy to a parser; the default None means the template."""
    parser.add_argument(
        "--anatomy", type=Path, help="anatomy from `sulcus anatomy`, .vtu (default: the template that ships)"
    )


def add_device(parser: argparse.ArgumentParser, purpose: str = "") -> None:
    """Add --device for one device to a parser; `purpose` names its work in the help, if it is a part of the command."""
    parser.add_argument(
        "--device", default="auto", help=f"compute device{purpose and f' for {purpose}'}: auto, cpu, cuda or cuda:1"
    )


def add_devices(parser: argparse.ArgumentParser, purpose: str = "") -> None:
    """Add --device for several devices to a parser; `purpose` is a text about their work at the end of the help."""
    parser.add_argument(
        "--device", default="auto", metavar="DEVICES",
        help=f"compute devices: auto, cpu, cuda, all, or a list such as cuda:0,cuda:1 with one process each{purpose}",
    )  # fmt: skip


def add_seed(
    parser: argparse.ArgumentParser, purpose: str = "the random draw", parse: Callable[[str], int] = int
) -> None:
    """Add the option --seed to a parser; `purpose` completes its help, and `parse` converts its text."""
    parser.add_argument("--seed", type=parse, default=0, help=f"seed of {purpose}")


def add_json(parser: argparse.ArgumentParser, purpose: str = "print one JSON line instead of text") -> None:
    """Add the option --json to a parser; `purpose` is its help."""
    parser.add_argument("--json", action="store_true", help=purpose)


def to_json_line(value: Any) -> str:
    """Format a value as one line of JSON; numbers that are not finite become null."""
    return json.dumps(_replace_non_finite(value), allow_nan=False)


def _replace_non_finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _replace_non_finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_replace_non_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def add_style(parser: argparse.ArgumentParser, excluded_styles: tuple[Style, ...] = ()) -> None:
    """Add the option --style of the overlay to a parser, without the styles `excluded_styles`."""
    from ar.overlay.styles import STYLES

    styles: list[Style] = [style for style in STYLES if style not in excluded_styles]
    descriptions = "; ".join(f"{style}: {STYLES[style]}" for style in styles if style != "none")
    parser.add_argument("--style", choices=styles, default="window", help=f"overlay style; {descriptions}")


def add_address(parser: argparse.ArgumentParser) -> None:
    """Add the option --address to a parser."""
    parser.add_argument(
        "--address", action="append", default=[], metavar="https://NAME[:PORT]",
        help="public address of the page behind a proxy, a tunnel or a forwarded port, which requires a token; "
        "repeatable",
    )  # fmt: skip


def list_addresses(args: argparse.Namespace) -> tuple[str, ...]:
    """Return the addresses of --address in the form of a browser's Origin header.

    Raises
    ------
    InputError
        A text is not an address.
    """
    from ar.page.access_guard import format_origin

    try:
        return tuple(map(format_origin, args.address))
    except ValueError as error:
        raise InputError(f"--address {error}") from error


def print_addresses(browser: Browser) -> None:
    """Print the additional addresses of the page, or a hint on the use of its token."""
    for address in browser.addresses:
        print(f"sulcus: behind the proxy or the forwarded port, open {address}", flush=True)
    if browser.token is not None and not browser.addresses:
        print("others than this machine reach the page by its name or address in place of localhost, with this token")
