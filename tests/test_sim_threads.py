"""Threads: a limit for the whole process, and tasks that all run, with errors raised at the end."""

import threading
from types import SimpleNamespace

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from sim.runtime.device import find_device
from sim.runtime.threads import (
    ThreadLimits,
    choose_threads,
    enter_background,
    limit_to_one_thread,
    run_concurrently,
    run_in_foreground,
    wait_for_foreground,
)


def threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_thread_limit_lasts_until_last_context_exits() -> None:
    with threadpool_limits(2, "blas"):
        first, second = limit_to_one_thread(), limit_to_one_thread()
        first.__enter__()
        second.__enter__()
        assert threads() == {1}
        first.__exit__(None, None, None)
        assert threads() == {1}
        second.__exit__(None, None, None)
        assert threads() == {2}


def test_run_together_returns_after_every_task():
    done: list[int] = []
    for _ in range(50):
        run_concurrently([lambda number=number: done.append(number) for number in range(3)])
    assert sorted(done) == sorted([0, 1, 2] * 50)


def test_run_together_runs_tasks_concurrently():
    meeting = threading.Barrier(2, timeout=5.0)
    run_concurrently([meeting.wait, meeting.wait])


@pytest.mark.parametrize("bad", [0, 1])
def test_error_of_a_task_is_raised_after_the_others(bad: int):
    def fail():
        raise ValueError("no")

    done: list[int] = []
    tasks = [lambda: done.append(1), lambda: done.append(1)]
    tasks[bad] = fail
    with pytest.raises(ValueError, match="no"):
        run_concurrently(tasks)
    assert done == [1]
    run_concurrently([lambda: done.append(2)] * 2)
    assert done == [1, 2, 2]


def test_thread_count_is_positive_and_one_for_small_work() -> None:
    assert choose_threads(10**6) >= 1
    assert choose_threads(ThreadLimits().min_size - 1) == 1
    assert choose_threads(10**6, ThreadLimits(max_threads=1)) == 1


def test_background_thread_waits_for_foreground_work() -> None:
    passed = threading.Event()

    def work():
        enter_background()
        wait_for_foreground()
        passed.set()

    thread = threading.Thread(target=work)
    with run_in_foreground():
        wait_for_foreground()  # this thread is not in the background
        thread.start()
        assert not passed.wait(0.03)
    assert passed.wait(5.0)
    thread.join()


def test_kernel_launch_waits_for_the_foreground(monkeypatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr("sim.runtime.device.wait_for_foreground", lambda: asked.append(1))
    monkeypatch.setattr("sim.runtime.device.wp.launch", lambda *_, **__: None)
    monkeypatch.setattr("sim.runtime.device.load_module", lambda _: None)
    find_device("cpu", "float64").launch(SimpleNamespace(module=None), (1,), [], [])
    assert asked == [1]
