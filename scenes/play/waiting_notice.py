"""Notice to the user while a task takes a long time."""

import threading
import time as clock
from collections.abc import Callable

MIN_REPORTED_TIME = 0.3  # Waiting time that is reported [s].
POLL_INTERVAL = 0.1  # Polling interval [s].


class WaitingNotice:
    """Thread that calls `show` with the running task and its duration, and with an empty line at the end."""

    def __init__(self, show: Callable[[str], None]) -> None:
        self._say = show
        self._since: float | None = None
        self._what = ""
        self.noticed = False
        """True while the notice is shown."""
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="busy", daemon=True)
        self._thread.start()

    def begin_work(self, task: str) -> None:
        """Report the start of work on `task`, or the continuation of work with another task."""
        with self._lock:
            self._what = task
            self._since = clock.perf_counter() if self._since is None else self._since

    def end_work(self) -> None:
        """Report the end of the work; a shown notice is cleared."""
        with self._lock:
            self._since = None
            if self.noticed:
                self._say("")
            self.noticed = False

    def close(self) -> None:
        """Stop the thread."""
        self._closed.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._closed.wait(POLL_INTERVAL):
            with self._lock:
                waited = 0.0 if self._since is None else clock.perf_counter() - self._since
                if waited >= MIN_REPORTED_TIME:
                    self._say(f"{self._what} ... {waited:.0f} s")
                    self.noticed = True
