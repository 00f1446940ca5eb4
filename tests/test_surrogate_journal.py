"""The journal of a run: whose records it takes up."""

import pytest

from sim.errors import InputError
from surrogate.data.journal import HEAD, DamageWarning, opened


def test_records_of_another_run_are_not_taken_up_where_its_beginning_is_damaged(tmp_path):
    """Their own run still finds them: only its beginning is lost."""
    path, batch = tmp_path / "data.h5.partial", ("answers", 0)
    with opened(path, {"seed": "0"}) as journal:
        journal.add(batch, b"what was solved")
    damaged = bytearray(path.read_bytes())
    damaged[HEAD.size + 2] ^= 1
    path.write_bytes(damaged)
    with (
        pytest.raises(InputError, match="is no unfinished run, or its beginning is damaged"),
        opened(path, {"seed": "1"}),
    ):
        pass
    assert path.read_bytes() == damaged
    with pytest.warns(DamageWarning, match="its beginning"), opened(path, {"seed": "0"}) as journal:
        assert batch in journal and journal.read(batch) == b"what was solved"
