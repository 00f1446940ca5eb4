"""Images of episodes as PNG: lossless, and read by other libraries."""

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from scenes.episodes.png import encode_png


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (5, 1), (48, 64)])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_opencv_and_pillow_read_the_encoded_png(shape, kind):
    picture = np.random.default_rng(0).integers(0, np.iinfo(kind).max, shape, kind, endpoint=True)
    code = encode_png(picture)
    read = cv2.imdecode(code, cv2.IMREAD_UNCHANGED)
    assert read.dtype == kind
    np.testing.assert_array_equal(read, picture)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(code.tobytes()))), picture)


def test_non_contiguous_image_is_encoded_correctly():
    whole = np.arange(4000, dtype=np.uint16).reshape(40, 100)
    for picture in (whole[::2, 5:], whole.T, np.asfortranarray(whole)):
        np.testing.assert_array_equal(cv2.imdecode(encode_png(picture), cv2.IMREAD_UNCHANGED), picture)


def test_smooth_depth_png_is_as_small_as_with_opencv():
    y, x = np.mgrid[:120, :160] / 160.0
    depth = np.rint(30_000 + 4_000 * np.sin(3.0 * x) * np.cos(2.0 * y)).astype(np.uint16)
    assert len(encode_png(depth)) < 1.05 * len(cv2.imencode(".png", depth, [cv2.IMWRITE_PNG_STRATEGY, 0])[1])


def test_png_chunks_have_valid_checksums():
    code, at, names = encode_png(np.full((3, 4), 9, np.uint8)).tobytes(), 8, []
    while at < len(code):
        (length,) = struct.unpack(">I", code[at : at + 4])
        body = code[at + 4 : at + 8 + length]
        assert struct.unpack(">I", code[at + 8 + length : at + 12 + length]) == (zlib.crc32(body),)
        names.append(body[:4])
        at += 12 + length
    assert names == [b"IHDR", b"IDAT", b"IEND"]
