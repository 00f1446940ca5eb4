"""Pictures as bytes: read as they say, and no others."""

import cv2
import numpy as np
import pytest
from tiny_episodes import SCALE, packed

from ar.picture_bytes import decoded_colour, decoded_depth, decoded_labels, stated_size


def test_bytes_of_pictures_are_read_as_they_say_and_no_others():
    colour, grey = np.full((6, 8, 3), [250, 10, 90], np.uint8), np.full((6, 8), 7, np.uint8)
    jpeg, png = packed("colour", colour).tobytes(), packed("labels", grey).tobytes()
    assert stated_size(jpeg) == stated_size(png) == (8, 6)
    assert np.abs(decoded_colour(jpeg, 8, 6).astype(int) - colour).max() < 8
    assert np.array_equal(decoded_labels(png, 8, 6), grey)
    progressive = cv2.imencode(".jpg", colour, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    assert stated_size(progressive) == (8, 6)
    for code, words in (
        (b"", "neither"), (b"GIF89a", "neither"), (jpeg[:-9], "too early"), (png[:-9], "too early"),
        (jpeg[:4] + b"\0" * 50 + jpeg[-2:], "header"), (b"\xff\xd8\xff\xd9", "header"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            decoded_colour(code, 8, 6)
    with pytest.raises(ValueError, match="8 x 6 pixels in place of 8 x 7"):
        decoded_colour(jpeg, 8, 7)
    with pytest.raises(ValueError, match="8 bits"):
        decoded_depth(png, 8, 6, SCALE)
    with pytest.raises(ValueError, match="3 channels"):
        decoded_labels(packed("labels", colour).tobytes(), 8, 6)
    middle = len(png) - 20
    with pytest.raises(ValueError, match="damaged"):
        decoded_labels(png[:33] + b"\0" * (middle - 33) + png[middle:], 8, 6)
