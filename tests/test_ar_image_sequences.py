"""Order and pixels of images in folders."""

import struct

import cv2
import numpy as np
import pytest
from PIL import Image

from ar.tracking.image_sequences import read_images, read_video


@pytest.mark.parametrize(
    "names",
    [
        ["frame2.png", "frame9.JPG", "frame10.png", "frame100.jpeg"],
        ["a1_2.png", "a1_10.png", "a2_1.png", "A10_0.PNG"],
        ["t-2.png", "t-1.png", "t0.png", "t3.png", "t10.png"],
        ["-3.png", "-1.png", "0.png", "2.png"],
        ["frame-1.png", "frame-2.png", "frame-10.png"],
        ["2025-9-30.png", "2025-10-2.png", "2025-10-11.png"],
        ["7 end.png", "010 end.png", "0100 end.png"],
    ],
)
def test_images_of_folder_are_read_in_natural_order(tmp_path, names):
    for grey, name in enumerate(names):
        cv2.imwrite(str(tmp_path / name), np.full((8, 8), 20 * grey, np.uint8))
    with pytest.warns(UserWarning, match="order of the numbers in its names, not alphabetically"):
        found = [(each.name, round(each.time, 6)) for each in read_video(tmp_path, 10.0)]
    assert found == [(name, round(0.1 * number, 6)) for number, name in enumerate(names)]
    assert [each.name for each in read_images(tmp_path)] == names


def test_folder_in_alphabetical_order_gives_no_warning(tmp_path):
    for name in ("a09.png", "a10.png", "b1.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((8, 8), np.uint8))
    assert [each.name for each in read_video(tmp_path, 10.0)] == ["a09.png", "a10.png", "b1.png"]


def test_rotation_metadata_does_not_rotate_pixels(tmp_path):
    """A rotation by 90 degrees in a video's track header or in EXIF is ignored."""
    still = np.zeros((64, 96, 3), np.uint8)
    still[:32, :48] = 200
    film, turned = tmp_path / "film.mp4", tmp_path / "turned.mp4"
    video = cv2.VideoWriter(str(film), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (96, 64))
    for _ in range(3):
        video.write(still)
    video.release()
    code = bytearray(film.read_bytes())
    one, matrix = 1 << 16, code.index(b"tkhd") + 44
    assert struct.unpack_from(">9i", code, matrix)[:5] == (one, 0, 0, 0, one)
    struct.pack_into(">9i", code, matrix, 0, one, 0, -one, 0, 0, 64 * one, 0, 1 << 30)
    turned.write_bytes(code)
    plain = [each.grey for each in read_video(film, 10.0)]
    with pytest.warns(UserWarning, match=r"turned.mp4: its metadata turns it by \d+ degrees"):
        found = [each.grey for each in read_video(turned, 10.0)]
    np.testing.assert_array_equal(found, plain)
    exif = Image.Exif()
    exif[0x0112] = 6  # orientation
    Image.fromarray(still).save(tmp_path / "a.jpg", exif=exif)
    assert next(iter(read_images(tmp_path))).grey.shape == (64, 96)
