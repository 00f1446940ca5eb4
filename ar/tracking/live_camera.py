"""What a camera of this machine sees, as time goes on."""

from __future__ import annotations

import threading
import time as clock
from collections.abc import Callable, Generator, Iterator
from typing import Protocol

import cv2
import numpy as np

from .pictures import Named, in_colour

# So many pictures in a row may fail before the camera is opened again, with a pause between them [s].
FAILURES, PAUSE = 10, 0.05


class Source(Protocol):
    """What gives pictures: `cv2.VideoCapture`, or what stands for one."""

    def isOpened(self) -> bool:
        """Whether it can be asked."""
        ...

    def read(self) -> tuple[bool, np.ndarray | None]:
        """Whether there was a picture, and the picture (H, W, 3) uint8, blue first."""
        ...

    def release(self) -> None:
        """Let it go."""
        ...


def opened(number: int, width: int, height: int) -> Source:
    """The camera of this machine with a number, asked for pictures of a size, of which it holds back none."""
    camera = cv2.VideoCapture(number)
    camera.set(cv2.CAP_PROP_FRAME_WIDTH, width)
    camera.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
    camera.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    return camera


def camera_pictures(
    source: Source, name: str, again: Callable[[], Source], now: Callable[[], float] = clock.perf_counter
) -> Generator[Named | None]:
    """Pictures of a camera, each with the moment [s] by `now` at which it was there; None where there was none.

    A camera that gives no more is let go, and opened `again` until it gives some.
    """
    failed = 0
    try:
        while True:
            good, frame = source.read() if source.isOpened() else (False, None)
            if good and frame is not None:
                failed = 0
                yield in_colour(name, cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), now())
                continue
            yield None
            failed += 1
            clock.sleep(PAUSE)
            if failed % FAILURES == 0:
                source.release()
                source = again()
    finally:
        source.release()


def newest(pictures: Generator[Named | None], patience: float) -> Iterator[Named | None]:
    """The newest picture that has come each time one is asked for; None where none came for so long [s].

    A thread of its own takes the pictures: those that come while nobody asks are lost, and none waits. It ends, and
    closes the pictures, with the last that is had here.

    Raises
    ------
    Exception
        Whatever the pictures raised.
    """
    waiting: list[Named] = []
    ended: list[BaseException | None] = []
    came, left = threading.Condition(), threading.Event()

    def take() -> None:
        failure: BaseException | None = None
        try:
            for picture in pictures:
                if left.is_set():
                    break
                if picture is not None:
                    with came:
                        waiting[:] = [picture]
                        came.notify()
        except Exception as error:
            failure = error
        pictures.close()
        with came:
            ended.append(failure)
            came.notify()

    threading.Thread(target=take, name="camera", daemon=True).start()
    try:
        while True:
            with came:
                came.wait_for(lambda: waiting or ended, patience)
                picture, over = (waiting.pop() if waiting else None), list(ended)
            if picture is None and over:
                if over[0] is not None:
                    raise over[0]
                return
            yield picture
    finally:
        left.set()
