"""Both programs in one: words that begin with `benchmarks` are for `python -m benchmarks`, others for `sulcus`."""

from pathlib import Path

from benchmarks.__main__ import main as benchmarks
from scenes.cli import main as sulcus
from sim.anatomy import Anatomy
from sim.bodies.meshfile import write_anatomy


def main(words):
    """Run one command; its exit code."""
    return benchmarks(words[1:]) if words[:1] == ["benchmarks"] else sulcus(words)


def simulated(anatomy: Anatomy, folder: Path, *words: str) -> Path:
    """Two loads on a body, solved by the command; its data file."""
    write_anatomy(folder / "body.vtu", anatomy)
    command = ["simulate", str(folder / "body.vtu"), "--out", str(folder / "data.h5"), "--count", "2", "--json"]
    assert main([*command, "--device", "cpu", *words]) == 0
    return folder / "data.h5"
