"""The journal of a run: the records that it resumes."""

from dataclasses import dataclass

import pytest

from sim.errors import InputError
from sim.runtime.journal import RECORD_HEADER, DamageWarning, open_journal, read_description


def test_damaged_journal_header_discards_records(tmp_path):
    """The original run still finds them: only the header is lost."""
    path, batch = tmp_path / "data.h5.partial", ("answers", 0)
    with open_journal(path, {"seed": "0"}) as journal:
        journal.add(batch, b"what was solved")
    damaged = bytearray(path.read_bytes())
    damaged[RECORD_HEADER.size + 2] ^= 1
    path.write_bytes(damaged)
    with (
        pytest.raises(InputError, match="is not an unfinished run, or its beginning is damaged"),
        open_journal(path, {"seed": "1"}),
    ):
        pass
    assert path.read_bytes() == damaged
    with pytest.warns(DamageWarning, match="its beginning"), open_journal(path, {"seed": "0"}) as journal:
        assert batch in journal and journal.read(batch) == b"what was solved"


@dataclass(frozen=True)
class Row:
    number: int
    residual: float


ROWS = [Row(number, 0.5 * number) for number in range(3)]


def test_journal_rows_are_read_except_truncated_ones(tmp_path):
    path = tmp_path / "trial.rows"
    with open_journal(path, {"seed": "0"}) as journal:
        for row in ROWS:
            journal.append(row)
    assert read_description(path) == {"seed": "0"}
    path.write_bytes(path.read_bytes()[:-3])
    with open_journal(path, {"seed": "0"}) as journal:
        assert journal.read_rows(Row) == ROWS[:2] and len(journal) == 2
        journal.append(ROWS[2])
        assert journal.read_rows(Row) == ROWS
    with pytest.raises(InputError, match="was begun with seed 0, but now seed is 1"), open_journal(path, {"seed": "1"}):
        pass


@pytest.mark.parametrize(
    "content", [b"sulcus rows 1 a table\n", b"# this trial\nsize,asked\n", b"\xff\xfe", b"", b"[" * 10**5]
)
def test_files_that_are_not_journals_are_rejected(tmp_path, content):
    path = tmp_path / "trial.rows"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"is not an unfinished run.*delete it"), open_journal(path, {}):
        pass
    assert path.read_bytes() == content and read_description(path) == {}
