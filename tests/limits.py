"""Limits of memory and of file sizes for a block of a test."""

import tracemalloc
from contextlib import contextmanager

import pytest


@contextmanager
def memory_below(limit):
    """Fail if Python allocates `limit` bytes or more within the block."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < limit
    finally:
        tracemalloc.stop()


@contextmanager
def files_below(limit):
    """Let no file grow beyond `limit` bytes, as on a full disk."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
