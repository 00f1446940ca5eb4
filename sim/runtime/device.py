"""Device and precision of Warp arrays."""

import ctypes
import os
import sys
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing import parent_process
from threading import Lock
from typing import Any

import numpy as np
import warp as wp

from ..accuracy import Precision
from ..errors import InputError
from .kernel_cache import ensure_writable_cache
from .threads import wait_for_foreground

forward_kernel = partial(wp.kernel, enable_backward=False, grid_stride=False)
"""Decorator `wp.kernel` without the unused adjoint, and without a grid-stride loop, which saves registers."""

STDERR = 2  # File descriptor of the error output.
ALL_GPUS = "all"
"""Name that means all GPUs in a list of devices."""

SCALARS: dict[Precision, Any] = {"float32": wp.float32, "float64": wp.float64}  # Warp's scalar types.


@dataclass(frozen=True)
class Device:
    """Warp device, by name, and precision of the arrays on this device."""

    name: str
    precision: Precision

    @property
    def scalar(self) -> Any:
        """Scalar type of Warp."""
        return SCALARS[self.precision]

    @property
    def matrix(self) -> Any:
        """3 x 3 matrix type of Warp, with the scalar type."""
        return wp.types.matrix((3, 3), self.scalar)

    @property
    def vector(self) -> Any:
        """3-vector type of Warp, with the scalar type."""
        return wp.types.vector(3, self.scalar)

    @property
    def on_cuda(self) -> bool:
        """True if arrays are on a GPU."""
        return self.name.startswith("cuda")

    def allocate(self, *shape: int) -> wp.array:
        """Return a zeroed array of the scalar type."""
        return wp.zeros(shape, dtype=self.scalar, device=self.name)

    def upload(self, values: np.ndarray, dtype: Any = None) -> wp.array:
        """Return a copy of `values` on the device, with the scalar type unless `dtype` is given."""
        return wp.array(np.ascontiguousarray(values), dtype=dtype or self.scalar, device=self.name)

    def launch(
        self, kernel: wp.Kernel, dim: tuple[int, ...], inputs: list[Any], outputs: list[Any], block_dim: int = 256
    ) -> None:
        """Launch a kernel on the device, in blocks of `block_dim` threads; an empty launch is skipped."""
        if min(dim) > 0:
            wait_for_foreground()
            if not self.on_cuda:
                load_module(kernel.module)
            wp.launch(
                kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.name, block_dim=block_dim,
                record_tape=False,
            )  # fmt: skip


_loading, _loaded = Lock(), set[wp.Module]()  # Lock of compilation; modules that are loaded on the CPU.


def load_module(module: wp.Module) -> None:
    """Load the module of a kernel on the CPU; a module that is not in the cache of Warp is compiled.

    Only one thread loads at a time, since Warp would otherwise compile a module once for each thread.
    """
    if module not in _loaded:
        with _loading:
            wp.load_module(module, device="cpu")  # does nothing if another thread was first
            _loaded.add(module)


def find_device(name: str, precision: Precision) -> Device:
    """Return the device with the name "cpu", "cuda", "cuda:1" or the like; "auto" is CUDA if available, else the CPU.

    Warp is initialised, without its default notes.

    Raises
    ------
    InputError
        The machine does not have the device, or the name means several devices.
    """
    if "," in name or name == ALL_GPUS:
        raise InputError(
            f"{name!r} names several devices, but only one is allowed here: choose "
            f"{' or '.join(['auto', *_list_devices()])}."
        )
    present = _list_devices()
    if name == "auto":
        name = "cuda:0" if "cuda:0" in present else "cpu"
    alias = "cuda:0" if name == "cuda" else name
    if alias not in present:
        why = _explain_no_gpu() if alias.startswith("cuda") else ""
        raise InputError(f"there is no device {name!r} here{why}: choose {' or '.join(['auto', *present])}.")
    return Device(alias, precision)


def parse_device_names(text: str) -> tuple[str, ...]:
    """Return the device names in a text such as "cuda:0,cuda:1", "cpu,cpu", "all" or "cuda".

    "all" means all GPUs. A device that occurs twice is shared by two processes.

    Raises
    ------
    InputError
        The machine does not have a device, "all" is used without GPUs or with other names, a name is empty, or CPU and
        GPUs are mixed.
    """
    if text.strip() == ALL_GPUS:
        cards = tuple(name for name in _list_devices() if name.startswith("cuda"))
        if not cards:
            raise InputError(
                f"'all' means every GPU, and there is none here{_explain_no_gpu()}: choose auto, or name devices "
                "separated by commas, as in cpu,cpu."
            )
        return cards
    asked = [name.strip() for name in text.split(",")]
    if ALL_GPUS in asked:
        raise InputError(f"{text!r} lists devices together with 'all', which means every GPU: give 'all' alone.")
    if not any(asked):
        raise InputError(f"{text!r} names no device: choose auto, or {' or '.join(_list_devices())}.")
    if not all(asked):
        raise InputError(f"{text!r} contains an empty device name: remove the comma, or add a name.")
    names = tuple(find_device(name, "float32").name for name in asked)
    if len({name.split(":")[0] for name in names}) > 1:
        raise InputError(
            f"{text!r} mixes CPU and GPUs, whose results differ in their last digits: choose devices of one kind."
        )
    return names


def _list_devices() -> list[str]:
    _start_warp()
    return [device.alias for device in wp.get_devices()]


@cache
def _start_warp() -> None:
    """Initialise Warp; if no CUDA driver is available, one line replaces the warning of the native code."""
    if wp.config.log_level == wp.LOG_INFO:  # its start-up notes would mix with a command's output
        wp.config.log_level = wp.LOG_ERROR
    if wp.config.kernel_cache_dir is None:
        ensure_writable_cache()
    if sys.stderr is None or _has_cuda_driver():
        wp.init()
        return
    shown = os.dup(STDERR)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), STDERR)
    try:
        wp.init()
    finally:
        os.dup2(shown, STDERR)
        os.close(shown)
    if parent_process() is None:
        os.write(STDERR, b"No CUDA GPU found: using the CPU.\n")


def _has_cuda_driver() -> bool:
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    return True


def _explain_no_gpu() -> str:
    return "" if wp.is_cuda_available() else ", as no NVIDIA driver with a GPU was found"
