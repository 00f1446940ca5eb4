"""How much memory this process has taken at most."""

from __future__ import annotations

from pathlib import Path


def peak_memory() -> float | None:
    """The largest resident size of this process so far [GiB], as Linux reports it."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) / 2**20 for line in lines if line.startswith("VmHWM:")), None)
