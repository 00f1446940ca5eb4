"""Image and video output: complete files with the given frames, and no partial files."""

import cv2
import numpy as np
import pytest
from limits import files_below
from tiny_episodes import SCALE, packed

from ar.screen import FrameFolder, decode_colour, decode_depth, decode_labels, read_image_size, read_png, write_movie


def picture(number: int = 0) -> np.ndarray:
    colour = np.zeros((48, 64, 3), np.uint8)
    colour[:, :, 0] = 200
    colour[10:20, 5 + 5 * number : 15 + 5 * number] = (30, 220, 90)
    return colour


def test_frames_are_written_to_the_folder_unchanged(tmp_path):
    screen = FrameFolder(tmp_path / "deep" / "frames")
    for number in (0, 1, 12):
        screen.show(number, picture(number))
    files = sorted(path.name for path in (tmp_path / "deep" / "frames").iterdir())
    assert files == ["frame_0000.png", "frame_0001.png", "frame_0012.png"]
    assert np.array_equal(read_png(tmp_path / "deep" / "frames" / "frame_0012.png"), picture(12))


def test_video_contains_every_frame_with_its_colours(tmp_path):
    write_movie(tmp_path / "film.mp4", (picture(number) for number in range(7)), 20.0)
    video = cv2.VideoCapture(str(tmp_path / "film.mp4"))
    frames = [frame for good, frame in iter(video.read, (False, None)) if good]
    assert len(frames) == 7
    assert np.abs(frames[3][..., ::-1].astype(int) - picture(3)).mean() < 12
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_animation_contains_every_frame_and_loops(tmp_path, suffix):
    write_movie(tmp_path / f"film{suffix}", (picture(number) for number in range(5)), 10.0)
    good, animation = cv2.imreadanimation(str(tmp_path / f"film{suffix}"))
    assert good and len(animation.frames) == 5 and animation.loop_count == 0
    assert list(animation.durations) == [100] * 5
    assert np.abs(animation.frames[2][..., 2::-1].astype(int) - picture(2)).mean() < 12


@pytest.mark.parametrize("suffix", [".mp4", ".gif", ".webp"])
def test_failed_video_leaves_no_file(tmp_path, suffix):
    def broken():
        yield picture()
        raise RuntimeError("the camera is gone")

    with pytest.raises(RuntimeError, match="camera"):
        write_movie(tmp_path / f"film{suffix}", broken())
    with pytest.raises(ValueError, match="at least one"):
        write_movie(tmp_path / f"film{suffix}", [])
    with pytest.raises(ValueError, match="one size"):
        write_movie(tmp_path / f"film{suffix}", [picture(), picture()[:20]])
    assert not list(tmp_path.iterdir())


def test_full_disk_leaves_no_partial_frame(tmp_path):
    with files_below(100), pytest.raises(OSError, match="large"):
        FrameFolder(tmp_path).show(0, picture())
    assert not list(tmp_path.iterdir())


def test_invalid_output_paths_are_rejected(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="folder"):
        FrameFolder(tmp_path / "file")
    with pytest.raises(ValueError, match="mp4"):
        write_movie(tmp_path / "film.avi", [picture()])
    with pytest.raises(ValueError, match="positive"):
        write_movie(tmp_path / "film.mp4", [picture()], 0.0)
    with pytest.raises(ValueError, match="not a readable image"):
        read_png(tmp_path / "file")


def test_image_decoders_reject_mismatched_or_damaged_bytes():
    colour, grey = np.full((6, 8, 3), [250, 10, 90], np.uint8), np.full((6, 8), 7, np.uint8)
    jpeg, png = packed("colour", colour).tobytes(), packed("labels", grey).tobytes()
    assert read_image_size(jpeg) == read_image_size(png) == (8, 6)
    assert np.abs(decode_colour(jpeg, 8, 6).astype(int) - colour).max() < 8
    assert np.array_equal(decode_labels(png, 8, 6), grey)
    progressive = cv2.imencode(".jpg", colour, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    assert read_image_size(progressive) == (8, 6)
    for code, words in (
        (b"", "neither"), (b"GIF89a", "neither"), (jpeg[:-9], "too early"), (png[:-9], "too early"),
        (jpeg[:4] + b"\0" * 50 + jpeg[-2:], "header"), (b"\xff\xd8\xff\xd9", "header"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            decode_colour(code, 8, 6)
    with pytest.raises(ValueError, match="8 x 6 pixels in place of 8 x 7"):
        decode_colour(jpeg, 8, 7)
    with pytest.raises(ValueError, match="8 bits"):
        decode_depth(png, 8, 6, SCALE)
    with pytest.raises(ValueError, match="3 channels"):
        decode_labels(packed("labels", colour).tobytes(), 8, 6)
    middle = len(png) - 20
    with pytest.raises(ValueError, match="damaged"):
        decode_labels(png[:33] + b"\0" * (middle - 33) + png[middle:], 8, 6)
