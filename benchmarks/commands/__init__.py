"""One file for each name of `python -m benchmarks`."""
