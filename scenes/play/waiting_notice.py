"""Notice about a task that takes a noticeable time."""

import threading
import time as clock
from collections.abc import Callable

MIN_REPORTED_TIME = 0.3  # Waiting time that is reported [s].
POLL_INTERVAL = 0.1  # Polling interval [s].


class WaitingNotice:
    """Thread that passes the running task and its duration to `say`, and an empty line at its end."""

    def __init__(self, show: Callable[[str], None]) -> None:
        self._say = show
        self._since: float | None = None
        self._what = ""
        self.noticed = False
        """True while the line is shown."""
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="busy", daemon=True)
        self._thread.start()

    def begin_work(self, task: str) -> None:
        """Mark the start or continuation of work on `task`."""
        with self._lock:
            self._what = task
            self._since = clock.perf_counter() if self._since is None else self._since

    def end_work(self) -> None:
        """Mark the end of the work."""
        with self._lock:
            self._since = None
            if self.noticed:
                self._say("")
            self.noticed = False

    def close(self) -> None:
        """Stop watching."""
        self._closed.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._closed.wait(POLL_INTERVAL):
            with self._lock:
                waited = 0.0 if self._since is None else clock.perf_counter() - self._since
                if waited >= MIN_REPORTED_TIME:
                    self._say(f"{self._what} ... {waited:.0f} s")
                    self.noticed = True
