"""How the overlay is drawn, on the command line."""

from __future__ import annotations

import argparse

from ar.overlay.styles import STYLES, Style


def add_style(parser: argparse.ArgumentParser, without: tuple[Style, ...] = ()) -> None:
    """Declare the overlay's style: shared by every command that draws a scene; some are of no use to some commands."""
    styles: list[Style] = [style for style in STYLES if style not in without]
    said = ". ".join(f"{style}: {STYLES[style]}" for style in styles if style != "none")
    parser.add_argument(
        "--style", choices=styles, default="window", help=f"how the overlay is drawn (default %(default)s). {said}"
    )
