"""Free memory as Linux reports it, and the error message for a batch that does not fit."""

import re
from pathlib import Path

import pytest

from sim.errors import InputError
from sim.runtime.columns import find_widest_workspace, find_workspace_width
from sim.runtime.device import Device, find_device
from sim.runtime.memory import MemoryBudget, check_fits, choose_batch_size, estimate_column_bytes, measure_host_bytes

ROWS = 3_000


def group(folder: Path, most: str, used: int, cached: int) -> MemoryBudget:
    for name, text in (("max", most), ("current", str(used)), ("stat", f"anon 5\ninactive_file {cached}\nfile 9\n")):
        (folder / f"memory.{name}").write_text(f"{text}\n")
    return MemoryBudget(cgroup=folder)


def test_control_group_limits_free_memory(tmp_path: Path) -> None:
    """Less its used memory; cached files are not counted as used."""
    plain = measure_host_bytes()
    assert measure_host_bytes(group(tmp_path, "50000000", 20_000_000, 3_000_000)) == 33_000_000
    assert measure_host_bytes(group(tmp_path, "max", 20_000_000, 0)) == pytest.approx(plain, rel=0.2)
    assert measure_host_bytes(MemoryBudget(cgroup=tmp_path / "none")) == pytest.approx(plain, rel=0.2)


@pytest.mark.parametrize(("batch", "count"), [(64, 2_000), (512, 400)])
def test_reported_batch_limit_is_the_largest_that_fits(batch: int, count: int, tmp_path: Path) -> None:
    budget = group(tmp_path, "100000000", 0, 0)
    device = find_device("cpu", "float64")
    with pytest.raises(InputError) as refusal:
        check_fits(ROWS, batch, count, device, budget=budget)
    found = re.search(r"(at most|--batch of) (\d+)", str(refusal.value))
    assert found
    fitting = int(found[2])
    if found[1] == "at most":
        check_fits(ROWS, 1, fitting, device, budget=budget)
        with pytest.raises(InputError, match="at most"):
            check_fits(ROWS, 1, fitting + 1, device, budget=budget)
    else:
        check_fits(ROWS, fitting, count, device, budget=budget)
        with pytest.raises(InputError, match="--batch"):
            check_fits(ROWS, fitting + 1, count, device, budget=budget)


def test_mesh_without_room_for_one_load_is_rejected(tmp_path: Path) -> None:
    budget = group(tmp_path, "1000000", 0, 0)
    with pytest.raises(InputError, match="coarser mesh"):
        check_fits(ROWS, 1, 1, find_device("cpu", "float64"), budget=budget)


CARD = Device("cuda:0", "float32")


def test_workspaces_on_gpu_have_few_widths() -> None:
    counts = (1, 4, 5, 64, 65, 96, 97, 16384, 16385)
    assert [find_workspace_width(CARD, count) for count in counts] == [1, 4, 64, 64, 96, 96, 128, 16384, 32768]
    assert [find_widest_workspace(CARD, count) for count in (-3, 0, *counts)] == [
        -3, 0, 1, 4, 4, 64, 64, 96, 96, 16384, 16384,
    ]  # fmt: skip
    processor = Device("cpu", "float32")
    assert find_workspace_width(processor, 65) == find_widest_workspace(processor, 65) == 65


def test_batch_size_fills_the_gpu_workspace() -> None:
    """Memory for many loads gives as many as are efficient, at least one."""
    column = estimate_column_bytes(ROWS, CARD)
    batches = [choose_batch_size(ROWS, CARD, free * column) for free in (0, 2, 9, 100, 200, 10**9)]
    assert batches == [1, 1, 4, 4, 96, MemoryBudget.max_cases_on_cuda]
