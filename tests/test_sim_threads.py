"""A limit that belongs to the whole process, entered and left by several."""

from __future__ import annotations

from threadpoolctl import threadpool_info, threadpool_limits

from sim.runtime.threads import one_thread


def threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_it_lasts_until_the_last_has_left_and_then_is_gone() -> None:
    with threadpool_limits(2, "blas"):
        first, second = one_thread(), one_thread()
        first.__enter__()
        second.__enter__()
        assert threads() == {1}
        first.__exit__(None, None, None)
        assert threads() == {1}
        second.__exit__(None, None, None)
        assert threads() == {2}
