"""Console output with a limited number of lines per time."""

import sys
import time
from collections.abc import Callable
from contextlib import suppress

MAX_LINES = 10  # Maximum number of printed lines in an interval.
LINE_INTERVAL = 5.0  # Interval in which at most MAX_LINES lines are printed [s].
PREFIX = "sulcus link: "  # Start of each line.


def print_safely(line: str) -> None:
    """Print a line to standard error, without control characters; do nothing if standard error is closed."""
    plain = "".join(each if each.isprintable() else "?" for each in line)
    with suppress(OSError):
        print(f"{PREFIX}{plain}", file=sys.stderr, flush=True)


def limit_rate(write: Callable[[str], None], get_time: Callable[[], float] = time.monotonic) -> Callable[[str], None]:
    """Return a function that writes at most 10 lines in 5 s; the next line reports the number of suppressed lines."""
    begun, count, skipped = -LINE_INTERVAL, 0, 0

    def write_line(line: str) -> None:
        nonlocal begun, count, skipped
        if get_time() - begun >= LINE_INTERVAL:
            begun, count = get_time(), 0
        if count == MAX_LINES:
            skipped += 1
            return
        count += 1
        write(line + (f" ({skipped} lines left out)" if skipped else ""))
        skipped = 0

    return write_line


def format_address(host: str, port: int) -> str:
    """Return HOST:PORT; an IPv6 address is written in brackets."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
