"""One thread of BLAS: on small matrices several wait for one another, ages where something else runs on their cores."""

from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


@cache
def _loaded() -> ThreadpoolController:
    """The libraries that are loaded: to look for them takes a millisecond, to tell them a hundredth."""
    return ThreadpoolController()


def one_thread() -> AbstractContextManager:
    """While it is entered, the libraries that were loaded when it was first called use one thread."""
    return _loaded().limit(limits=1, user_api="blas")
