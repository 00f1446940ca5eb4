"""CPU kernels on several threads: Warp runs a kernel on the calling thread, so each thread gets a band of the image."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from threading import Lock
from types import ModuleType

import numpy as np
import warp as wp

forward_kernel = partial(wp.kernel, enable_backward=False, grid_stride=False)
"""Decorator `wp.kernel` without backward pass, launched with one thread per item: rendering needs no gradients."""


_loading = Lock()


def load_modules(device: str, *modules: wp.Module | ModuleType | str) -> None:
    """Load kernel modules on a device; modules that Warp has not cached are compiled, which takes seconds.

    One thread loads at a time, and others wait: otherwise Warp would compile a module once per thread.
    """
    with _loading:
        for module in modules:
            wp.load_module(module, device=device)


def launch_in_bands(kernel: wp.Kernel, inputs: list, outputs: list, count: int, device: str, per_core: int = 1) -> None:
    """Launch a kernel over `count` independent items; its first arguments are (begin, end, chunk size).

    On a CPU there are `per_core` bands per core; several bands balance items of unequal duration.
    """
    run = get_chunk_size(device)

    def launch(begin: int, end: int) -> None:
        wp.launch(kernel, -(-(end - begin) // run), [begin, end, run, *inputs], outputs, device=device)

    run_in_bands(launch, count, device, per_core)


def get_chunk_size(device: str) -> int:
    """Return the number of items per kernel thread: many on a CPU, as copying the arguments for each thread is slow."""
    return 64 if device == "cpu" else 1


def run_in_bands(process_band: Callable[[int, int], None], count: int, device: str, per_core: int = 1) -> None:
    """Call `process_band(begin, end)` on ranges of 0 .. count; in parallel on a CPU, with `per_core` ranges per core.

    Calls must not write to the same memory, and the modules of their kernels must be loaded.
    """
    pool, cores = get_workers()
    if device != "cpu" or cores == 1:
        return process_band(0, count)
    edges = np.linspace(0, count, per_core * cores + 1).astype(int).tolist()
    list(pool.map(process_band, edges[:-1], edges[1:]))


@cache
def get_workers() -> tuple[ThreadPoolExecutor, int]:
    """Return the thread pool for drawing and its number of threads; Warp releases the GIL in CPU kernels.

    There is one thread if `OMP_NUM_THREADS` is 1, as for several processes that share the cores.
    """
    cores = 1 if os.environ.get("OMP_NUM_THREADS") == "1" else min(os.cpu_count() or 1, 8)
    return ThreadPoolExecutor(cores, thread_name_prefix="raster"), cores
