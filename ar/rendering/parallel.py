"""Multi-threaded CPU kernels: Warp runs a kernel on the calling thread, so each thread gets a band of the image."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from threading import Lock
from types import ModuleType

import numpy as np
import warp as wp

forward_kernel = partial(wp.kernel, enable_backward=False, grid_stride=False)
"""`wp.kernel` without adjoint, launched as wide as the work: images are not differentiated here."""


_loading = Lock()


def load_modules(device: str, *modules: wp.Module | ModuleType | str) -> None:
    """Load modules of kernels on a device; those that Warp has not cached are compiled, which takes seconds.

    One thread does it at a time, and others wait: Warp alone would compile a module once per requesting thread.
    """
    with _loading:
        for module in modules:
            wp.load_module(module, device=device)


def launch_in_bands(kernel: wp.Kernel, inputs: list, outputs: list, count: int, device: str, per_core: int = 1) -> None:
    """Launch a kernel over `count` independent items; it takes (begin, end, run) first, see `get_chunk_size`.

    On a CPU there are `per_core` bands for each core: several if some items take longer than others.
    """
    run = get_chunk_size(device)

    def launch(begin: int, end: int) -> None:
        wp.launch(kernel, -(-(end - begin) // run), [begin, end, run, *inputs], outputs, device=device)

    run_in_bands(launch, count, device, per_core)


def get_chunk_size(device: str) -> int:
    """Return the number of items per kernel thread: on a CPU each thread copies its arguments, which costs the most."""
    return 64 if device == "cpu" else 1


def run_in_bands(draw: Callable[[int, int], None], count: int, device: str, per_core: int = 1) -> None:
    """Call `draw(begin, end)` on ranges that cover 0 .. count: `per_core` for each core, on a CPU.

    The ranges must not write to the same places; the modules of their kernels must be loaded.
    """
    pool, cores = get_workers()
    if device != "cpu" or cores == 1:
        return draw(0, count)
    edges = np.linspace(0, count, per_core * cores + 1).astype(int).tolist()
    list(pool.map(draw, edges[:-1], edges[1:]))


@cache
def get_workers() -> tuple[ThreadPoolExecutor, int]:
    """Return the drawing threads and their number: Warp runs a CPU kernel on the calling thread and releases the GIL.

    One, if `OMP_NUM_THREADS` is 1, as for several processes on the same cores.
    """
    cores = 1 if os.environ.get("OMP_NUM_THREADS") == "1" else min(os.cpu_count() or 1, 8)
    return ThreadPoolExecutor(cores, thread_name_prefix="raster"), cores
