"""Further addresses of a page: those that a proxy, a tunnel or a forwarded port gives it."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from sim.errors import InputError

if TYPE_CHECKING:
    from ar.page.browser import Browser


def add_address(parser: argparse.ArgumentParser) -> None:
    """Declare --address."""
    parser.add_argument(
        "--address", action="append", default=[], metavar="https://NAME[:PORT]",
        help="address of the page behind a proxy, a tunnel or another port, which then asks for a token; repeatable",
    )  # fmt: skip


def addresses_of(args: argparse.Namespace) -> tuple[str, ...]:
    """Addresses as browsers write them.

    Raises
    ------
    InputError
        A text that is no such address.
    """
    from ar.page.guard import origin_of

    try:
        return tuple(map(origin_of, args.address))
    except ValueError as error:
        raise InputError(f"--address {error}") from error


def say_addresses(browser: Browser) -> None:
    """Print where else the page is, if a token is needed there."""
    for address in browser.addresses:
        print(f"sulcus: behind the proxy or the forwarded port, open {address}", flush=True)
    if browser.token is not None and not browser.addresses:
        print("others than this machine reach the page by its name or address in place of localhost, with this token")
