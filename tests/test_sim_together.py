"""Tasks on several threads: all done, errors raised where they are waited for."""

import threading

import pytest

from sim.together import cores, together


def test_every_task_is_done_when_it_returns():
    done: list[int] = []
    for _ in range(50):
        together([lambda number=number: done.append(number) for number in range(3)])
    assert sorted(done) == sorted([0, 1, 2] * 50)


def test_tasks_run_at_the_same_time():
    meeting = threading.Barrier(2, timeout=5.0)
    together([meeting.wait, meeting.wait])


@pytest.mark.parametrize("bad", [0, 1])
def test_errors_come_out_and_the_threads_stay(bad: int):
    def fail():
        raise ValueError("no")

    done: list[int] = []
    tasks = [lambda: done.append(1), lambda: done.append(1)]
    tasks[bad] = fail
    with pytest.raises(ValueError, match="no"):
        together(tasks)
    assert done == [1]
    together([lambda: done.append(2)] * 2)
    assert done == [1, 2, 2]


def test_one_core_at_least():
    assert cores() >= 1
