"""Videos that are read from any frame."""

import numpy as np
from films import FILM

from ar.tracking.image_sequences import read_video
from scenes.tracked.seekable_video import SeekableVideo


def test_seekable_video_reads_frames_in_any_order(tmp_path):
    film, pictures = SeekableVideo(FILM / "film.mp4", 30.0), list(read_video(FILM / "film.mp4", 30.0, with_colour=True))
    assert film.count == len(pictures) == 17
    for number in (3, 4, 16, 0):
        found = film.read_image(number)
        assert found.has_stamp and np.array_equal(found.source.colour, pictures[number].colour)
    film.count = 40  # as a file may say
    assert film.read_image(20) is None and film.count == 20 and film.read_image(17) is None and film.count == 17
    assert film.read_image(16).source.name == "frame 16"
