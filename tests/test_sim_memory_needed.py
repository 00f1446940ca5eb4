"""Memory that a batch needs, and the error when a GPU has less."""

import re

import pytest
from boxes import base_held, box
from test_sim_memory import CARD

from sim.accuracy import TRAIN
from sim.discretisation.space import discretise
from sim.errors import InputError
from sim.runtime.device import Device
from sim.runtime.memory import estimate_column_bytes
from sim.strategy.memory_needed import BYTES_PER_NODE, FIXED_BYTES, compute_memory, estimate_fem_memory

SPACE = discretise(box((6, 6, 6)), "smoothed")
TABLES = FIXED_BYTES + BYTES_PER_NODE["smoothed"] * SPACE.count


def test_gpu_memory_is_tables_inverse_and_loads() -> None:
    """An inverse takes half its square in double precision at first, and is kept in half precision."""
    rows, free = 3 * SPACE.count, 2**40
    one = compute_memory(SPACE, CARD, 0, 1, 5, free)
    assert one.peak_bytes == one.constant_bytes + one.bytes_per_load and one.constant_bytes == one.setup_bytes == TABLES
    many = compute_memory(SPACE, CARD, 0, 64, 5, free)
    assert many.batch == 5  # no more than there are loads
    assert many.peak_bytes - one.peak_bytes == 63 * one.bytes_per_load  # where 5 columns stand there is room for 64
    assert compute_memory(SPACE, CARD, 0, 4, 5, free).peak_bytes - one.peak_bytes == 3 * one.bytes_per_load
    inverted = compute_memory(SPACE, CARD, 50_000, 1, 1, free)
    assert 4 * 50_000**2 < inverted.setup_bytes - inverted.constant_bytes < 7 * 50_000**2
    assert inverted.peak_bytes == inverted.setup_bytes and inverted.constant_bytes - TABLES == 2 * 50_000**2
    wide = compute_memory(SPACE, Device("cuda:0", "float64"), 0, 1, 1, free)
    assert wide.bytes_per_load == 2 * one.bytes_per_load == 2 * estimate_column_bytes(rows, CARD)
    assert wide.constant_bytes - FIXED_BYTES == 2 * (one.constant_bytes - FIXED_BYTES)


def test_gpu_overflow_is_rejected_with_fitting_batch() -> None:
    free = 2 * FIXED_BYTES
    fits = compute_memory(SPACE, CARD, 0, None, 10**6, free).check_fits()
    assert fits.peak_bytes <= 0.9 * free and fits.batch > 100
    assert f"{fits.batch} loads together: about" in str(fits) and "of cuda:0, 2 GiB free" in str(fits)
    with pytest.raises(InputError, match=r"343 nodes .smoothed., 9999 loads together: .*: a --batch") as refusal:
        compute_memory(SPACE, CARD, 0, 9999, 9999, free).check_fits()
    found = re.search(r"--batch of (\d+) fits", str(refusal.value))
    assert found
    compute_memory(SPACE, CARD, 0, int(found[1]), 9999, free).check_fits()
    with pytest.raises(InputError, match="--batch"):
        compute_memory(SPACE, CARD, 0, int(found[1]) + 1, 9999, free).check_fits()
    with pytest.raises(InputError, match=r"one load at a time.* free: take a coarser mesh, or a larger machine"):
        compute_memory(SPACE, CARD, 50_000, 1, 1, free).check_fits()


def test_needed_memory_is_not_estimated_on_cpu() -> None:
    assert estimate_fem_memory(base_held(SPACE.mesh), None, TRAIN, "cpu", None, 10**9) is None
