"""Video recording of the page."""

import cv2
import numpy as np
import pytest

from ar.page.elements import to_data_url
from ar.page.recording import FRAME_RATE, MAX_DURATION, PageRecording, replay_images


class TestRecording:
    def test_video_shows_each_image_for_its_page_duration(self):
        codes = [to_data_url(np.full((48, 64, 3), grey, np.uint8)) for grey in (0, 100, 200)]
        shown = list(replay_images([(5.0, codes[0]), (6.0, codes[1]), (6.2, codes[2])], 7.0, 10.0))
        assert [round(float(picture.mean()), -2) for picture in shown] == [0.0] * 10 + [100.0] * 2 + [200.0] * 8

    def test_recording_is_readable_mp4_of_bounded_length(self, tmp_path):
        recording = PageRecording(0.0)
        for number in range(20):
            recording.add_image(to_data_url(np.full((48, 64, 3), 10 * number, np.uint8)), 0.1 * number)
        recording.add_image(to_data_url(np.zeros((48, 64, 3), np.uint8)), MAX_DURATION + 1.0)
        assert len(recording.images) == 20 and recording.is_full(MAX_DURATION)
        (tmp_path / "film.mp4").write_bytes(recording.encode_video(2.0))
        film = cv2.VideoCapture(str(tmp_path / "film.mp4"))
        assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 2 * FRAME_RATE
        assert film.read()[1].shape == (48, 64, 3)

    def test_empty_recording_is_rejected(self):
        with pytest.raises(ValueError, match="at least one image"):
            PageRecording(0.0).encode_video(1.0)
