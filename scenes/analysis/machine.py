"""Hardware and versions that a figure was measured with."""

from __future__ import annotations

import os
import platform
from datetime import date

import warp as wp

from sim.runtime.device import find_device
from sim.runtime.versions import version_of


def machine(device: str) -> str:
    """Hardware, versions and date, in one line.

    Raises
    ------
    InputError
        A device that this machine does not have.
    """
    names = [wp.get_device(find_device(device, "float32").name).name]
    try:
        with open("/proc/cpuinfo") as file:
            names += [line.split(":")[1].strip() for line in file if line.startswith("model name")][:1]
    except OSError:
        names.append(platform.processor())
    versions = ", ".join(f"{name} {version_of(name)}" for name in ("sulcus", "warp-lang", "torch", "numpy"))
    return (
        f"{' / '.join(names)}, {os.cpu_count()} cores; Python {platform.python_version()}, {versions}; {date.today()}"
    )
