"""`sulcus markers`: write printable pages with tracking targets, and a list of the targets."""

import argparse
import json
from pathlib import Path

from ..options.outputs import add_force, check_output_path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR",
        help="folder for markers.pdf, a PNG of each page, and targets.json with all corners [mm]",
    )  # fmt: skip
    add_force(parser)


def run(args: argparse.Namespace) -> int:
    """Write the pages and the list of targets; return 0.

    Raises
    ------
    InputError
        Files of these names exist and are not to be replaced, or the folder is not writable.
    """
    from ar.tracking.pages import DPI, build_printed_pages, describe_targets, to_pdf, to_png
    from sim.runtime.atomic_files import write_atomically

    pages = build_printed_pages()
    pictures = [check_output_path(args.out / f"{page.name}.png", ".png", args.force) for page in pages]
    book = check_output_path(args.out / "markers.pdf", ".pdf", args.force)
    table = check_output_path(args.out / "targets.json", ".json", args.force)
    contents = {
        book: to_pdf(pages),
        **{path: to_png(page) for path, page in zip(pictures, pages, strict=True)},
        table: (json.dumps(describe_targets(), indent=1) + "\n").encode(),
    }
    for path, content in contents.items():
        with write_atomically(path, path.suffix) as partial:
            partial.write_bytes(content)
    print(f"{book}: {len(pages)} pages of A4, also as PNG of {DPI:.0f} dpi; what is on them: {table}")
    print("Print at 100 %, then measure the rulers: each must be 100 mm long.")
    return 0
