"""Access to the images of a video by number."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from ar.tracking.image_sequences import count_frames, read_video

from .run import TimedImage, read_timed_images


@dataclass(eq=False)
class SeekableVideo:
    """Video or folder of images, whose images are read by number.

    Parameters
    ----------
    path
        Path of the video or folder; for errors see `ar.tracking.image_sequences.read_video`.
    rate
        Frame rate of a folder [1/s].
    count
        Number of images; corrected if the video ends earlier.
    """

    path: Path
    rate: float
    count: int = field(init=False)
    images: Iterator[TimedImage] = field(init=False)
    next_number: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        """Count the images and open the video."""
        self.count = count_frames(self.path)
        self.images = self._read_from(0)

    def _read_from(self, number: int) -> Iterator[TimedImage]:
        return read_timed_images(read_video(self.path, self.rate, with_colour=True, first_frame=number))

    def read_image(self, number: int) -> TimedImage | None:
        """Return image `number`; None if the video ends before this image, and `count` is then corrected."""
        if number != self.next_number:
            # Read from the start: seeking in a video does not reach every frame.
            self.images = self._read_from(number)
        found, self.next_number = next(self.images, None), number + 1
        if found is None:
            self.count, self.next_number = min(self.count, number), -1
        return found
