"""What memory is free, as Linux says it, and the sentence when a batch does not fit."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sim.errors import InputError
from sim.runtime.device import find_device
from sim.runtime.memory import Budget, check_fits, host_bytes

ROWS = 3_000


def group(folder: Path, most: str, used: int, cached: int) -> Budget:
    for name, text in (("max", most), ("current", str(used)), ("stat", f"anon 5\ninactive_file {cached}\nfile 9\n")):
        (folder / f"memory.{name}").write_text(f"{text}\n")
    return Budget(group=folder)


def test_a_control_group_bounds_what_is_free(tmp_path: Path) -> None:
    """Less what it uses; files that are merely cached are given up."""
    plain = host_bytes()
    assert host_bytes(group(tmp_path, "50000000", 20_000_000, 3_000_000)) == 33_000_000
    assert host_bytes(group(tmp_path, "max", 20_000_000, 0)) == pytest.approx(plain, rel=0.2)
    assert host_bytes(Budget(group=tmp_path / "none")) == pytest.approx(plain, rel=0.2)


@pytest.mark.parametrize(("batch", "count"), [(64, 2_000), (512, 400)])
def test_what_is_said_to_fit_does_and_one_more_does_not(batch: int, count: int, tmp_path: Path) -> None:
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


def test_a_mesh_of_which_not_one_load_fits_is_reported(tmp_path: Path) -> None:
    budget = group(tmp_path, "1000000", 0, 0)
    with pytest.raises(InputError, match="coarser mesh"):
        check_fits(ROWS, 1, 1, find_device("cpu", "float64"), budget=budget)
