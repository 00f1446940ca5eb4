"""Rows of a table that a stopped run has made, and what is made of a file that is torn or of something else."""

import numpy as np
import pytest

from surrogate.training.kept_rows import KeptRows

TABLE = np.arange(24, dtype=np.float32).reshape(6, 2, 2)


def restored(kept):
    table = np.full_like(TABLE, -1.0)
    count = kept.restore(table)
    assert np.array_equal(table, [*TABLE[:count], *np.full_like(TABLE[count:], -1.0)])
    return count


@pytest.fixture
def kept(tmp_path):
    """Four rows, in two steps."""
    made = KeptRows(tmp_path / "rows", "one table")
    assert not made.some and restored(made) == 0 and not made.some
    made.add(0, TABLE[:3])
    made.add(3, TABLE[3:4])
    return made


def test_what_was_made_is_there_and_goes_on(kept):
    assert restored(kept) == 4
    kept.add(4, TABLE[4:])
    assert restored(kept) == 6 and kept.some and not KeptRows(kept.path, "two tables").some


def test_rows_after_a_torn_or_a_wrong_one_are_made_anew(kept):
    whole = kept.path.read_bytes()
    kept.path.write_bytes(whole[:-3])
    assert restored(kept) == 3
    kept.add(3, TABLE[3:])  # where the torn one began
    assert restored(kept) == 6
    flipped = bytearray(whole)
    flipped[-10] ^= 1
    kept.path.write_bytes(flipped)
    assert restored(kept) == 3
    kept.add(4, TABLE[4:5])  # as of two runs at once: only the fourth row may stand there
    assert restored(kept) == 3


def test_rows_of_another_table_are_dropped_and_another_file_stays(kept):
    other = KeptRows(kept.path, "two tables")
    kept.add(4, TABLE[4:])
    assert restored(other) == 0 and restored(kept) == 0
    kept.path.write_text("a letter")
    kept.add(0, TABLE)
    assert restored(kept) == 0 and kept.path.read_text() == "a letter"


def test_where_nothing_can_be_written_nothing_is_kept(tmp_path):
    nowhere = KeptRows(tmp_path / "no" / "rows", "one table")
    assert restored(nowhere) == 0
    nowhere.add(0, TABLE)
    assert restored(nowhere) == 0 and not nowhere.path.parent.exists()
