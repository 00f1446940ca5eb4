"""Kernels on a device, launched from several threads."""

import threading
import time

import numpy as np
import pytest
import warp as wp

from sim.runtime.device import Device, forward_kernel


def test_concurrent_kernel_is_compiled_once(monkeypatch: pytest.MonkeyPatch) -> None:
    inside, most = [], []
    load = wp.load_module

    def slow(module: wp.Module, device: str) -> None:
        inside.append(module)
        most.append(len(inside))
        time.sleep(0.1)
        load(module, device=device)
        inside.remove(module)

    monkeypatch.setattr(wp, "load_module", slow)
    device = Device("cpu", "float64")

    @forward_kernel(module="unique")
    def add_seven(x: wp.array(dtype=wp.float64)):  # pyright: ignore[reportInvalidTypeForm]
        i = wp.tid()
        x[i] = x[i] + wp.float64(7.0)

    outputs = [device.allocate(3) for _ in range(4)]
    threads = [threading.Thread(target=device.launch, args=(add_seven, (3,), [], [out])) for out in outputs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(out.numpy(), [7.0, 7.0, 7.0]) for out in outputs)
    assert max(most) == 1
    before = len(most)
    device.launch(add_seven, (3,), [], [outputs[0]])
    assert len(most) == before and outputs[0].numpy()[0] == 14.0
