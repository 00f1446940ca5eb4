"""Live images of a camera that is connected to this machine."""

import threading
import time as clock
from collections.abc import Callable, Generator, Iterator
from typing import Protocol

import cv2
import numpy as np

from .image_sequences import NamedImage, to_named_image

MAX_FAILURES = 10  # Number of consecutive failed images before the camera is opened again.
RETRY_PAUSE = 0.05  # Pause between two tries [s].


class FrameSource(Protocol):
    """Source of images: `cv2.VideoCapture` or a replacement, as for tests."""

    def isOpened(self) -> bool:
        """Return True if the source is open."""
        ...

    def read(self) -> tuple[bool, np.ndarray | None]:
        """Return True and the image (H, W, 3) uint8 in BGR order; False if no image arrived."""
        ...

    def release(self) -> None:
        """Release the device."""
        ...


def open_camera(number: int, width: int, height: int) -> FrameSource:
    """Open the camera with this device number, for images of the given size, with a buffer of one image."""
    camera = cv2.VideoCapture(number)
    camera.set(cv2.CAP_PROP_FRAME_WIDTH, width)
    camera.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
    camera.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    return camera


def read_camera_images(
    source: FrameSource, name: str, reopen: Callable[[], FrameSource], now: Callable[[], float] = clock.perf_counter
) -> Generator[NamedImage | None]:
    """Yield images of a camera, each with its arrival time [s] by the clock `now`; yield None if there is no image.

    A camera that stops responding is released, and opened again by `reopen` until it responds.
    """
    failed = 0
    try:
        while True:
            good, frame = source.read() if source.isOpened() else (False, None)
            if good and frame is not None:
                failed = 0
                yield to_named_image(name, cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), now())
                continue
            yield None
            failed += 1
            clock.sleep(RETRY_PAUSE)
            if failed % MAX_FAILURES == 0:
                source.release()
                source = reopen()
    finally:
        source.release()


def read_newest_images(images: Generator[NamedImage | None], timeout: float) -> Iterator[NamedImage | None]:
    """Yield the newest image at each request; yield None if none arrives within `timeout` [s].

    A separate thread reads `images`; those that arrive between requests are dropped. The thread ends and closes
    `images` when this iterator ends.

    Raises
    ------
    Exception
        Any exception that `images` raises.
    """
    waiting: list[NamedImage] = []
    ended: list[BaseException | None] = []
    came, left = threading.Condition(), threading.Event()

    def read_images() -> None:
        failure: BaseException | None = None
        try:
            for picture in images:
                if left.is_set():
                    break
                if picture is not None:
                    with came:
                        waiting[:] = [picture]
                        came.notify()
        except Exception as error:
            failure = error
        images.close()
        with came:
            ended.append(failure)
            came.notify()

    threading.Thread(target=read_images, name="camera", daemon=True).start()
    try:
        while True:
            with came:
                came.wait_for(lambda: waiting or ended, timeout)
                picture, over = (waiting.pop() if waiting else None), list(ended)
            if picture is None and over:
                if over[0] is not None:
                    raise over[0]
                return
            yield picture
    finally:
        left.set()
