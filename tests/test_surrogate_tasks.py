"""Batches shared by processes after one process is killed."""

import pytest
from on_devices import mortal, small_body
from test_surrogate_solver_pool import COUNT, SAID, undated

from sim.errors import InputError
from sim.runtime.processes import process_pool
from surrogate.data.simulate import simulate
from surrogate.data.tasks import SolverPool
from surrogate.data.tool_loads import draw


@pytest.fixture(scope="module")
def body():
    return small_body()


def test_killed_solver_process_loses_no_finished_case(tmp_path, body):
    """One of two processes dies at the sixth of ten batches; the resumed file equals that of a complete run."""
    loads, whole, path = draw("palpation", body, COUNT, 0), tmp_path / "whole.h5", tmp_path / "data.h5"
    undisturbed = mortal("cpu", COUNT, 0, tmp_path)
    simulate(whole, undisturbed, loads, SAID, 2)
    done = []
    sentence = r"the process on cpu was ended \(Killed\).*--device one cpu less. What was solved is kept: the same com"
    with (
        process_pool(["cpu", "cpu"], mortal, COUNT, 11, tmp_path / "mark") as children,
        pytest.raises(InputError, match=sentence),
    ):
        simulate(path, SolverPool(body, children), loads, SAID, 2, lambda *now: done.append(now[0]))
    assert not path.exists() and path.with_name("data.h5.partial").stat().st_size > 0
    left = 3 * int(body.craniotomy.sum()) + COUNT - max(done)
    assert 2 <= left <= 10  # what came after the sixth, and it
    assert simulate(path, undisturbed, loads, SAID, 2).total == left
    assert undated(path) == undated(whole)
