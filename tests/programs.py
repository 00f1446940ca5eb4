"""Both programs in one: words that begin with `benchmarks` are for `python -m benchmarks`, others for `sulcus`."""

from benchmarks.__main__ import main as benchmarks
from scenes.cli import main as sulcus


def main(words):
    """Run one command; its exit code."""
    return benchmarks(words[1:]) if words[:1] == ["benchmarks"] else sulcus(words)
