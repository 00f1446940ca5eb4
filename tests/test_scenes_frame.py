"""`python -m benchmarks frame`: time of each stage of a frame, and images sent to the page."""

import json
from functools import partial

import pytest
from theatres import put, short, theatre_of

from ar.page.browser import Browser
from ar.rendering.renderer import Renderer
from benchmarks.__main__ import main
from benchmarks.studies import frame
from benchmarks.studies.frame import (
    STAGES,
    WARM_UP,
    measure_batch_rate,
    parse_image_size,
    summarise_stages,
    time_frames,
)
from scenes.play.player import Player


def test_benchmark_draws_and_sends_each_frame_once(box, monkeypatch):
    drawn, sent, play, send_image_element = [], [], Player.draw_frame, Browser.send_image_element

    def seen(player, number, *rest):
        drawn.append(number)
        return play(player, number, *rest)

    def heard(page, code, words):
        sent.append((code, words))
        send_image_element(page, code, words)

    monkeypatch.setattr(Player, "draw_frame", seen)
    monkeypatch.setattr(Browser, "send_image_element", heard)
    player = theatre_of(box).build_player("linear", short())
    found = list(time_frames(player, 4))
    assert len(found) == 4 and all(len(row) == len(STAGES) and min(row) > 0.0 for row in found)
    assert drawn == [number % len(player.scene.times) for number in range(WARM_UP + 4)]
    pictures = [code for code, _ in sent if code.startswith("data:image/jpeg")]
    assert len(pictures) == WARM_UP + 4 and len(set(pictures)) > 3


def test_frame_time_is_the_sum_of_its_stages():
    rows = summarise_stages([(1.0, 2.0, 3.0, 4.0, 5.0, 6.0), (3.0, 2.0, 3.0, 4.0, 5.0, 6.0)])
    assert [row.stage for row in rows] == [*STAGES, "frame"]
    assert (rows[0].median, rows[-1].median, rows[-1].mean) == (2000.0, 22000.0, 22000.0)
    assert rows[-1].p95 == pytest.approx(22900.0)


def test_batch_has_the_given_number_of_frames_and_cameras(box, monkeypatch):
    asked, pictures = [], Renderer.render_batch

    def heard(renderer, vertices, cameras):
        asked.append((vertices, cameras))
        return pictures(renderer, vertices, cameras)

    monkeypatch.setattr(Renderer, "render_batch", heard)
    assert measure_batch_rate(theatre_of(box).build_player("linear", short()), 3, 0.01) > 0.0
    vertices, cameras = asked[-1]
    assert len(asked) >= 2 and len({vertex.tobytes() for vertex in vertices}) > 1
    assert len({camera.T_camera_world.tobytes() for camera in cameras}) == len(cameras) == len(vertices) == 3


def test_frame_benchmark_reports_size_and_each_stage(box, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(frame, "measure_batch_rate", partial(frame.measure_batch_rate, duration=0.01))
    words = ["frame", "--anatomy", str(put(theatre_of(box), tmp_path / "box.vtu")), "--device", "cpu"]
    words += ["--deformer", "linear", "--size", "160x120", "--frames", "2"]
    assert main([*words, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert [row["stage"] for row in said["rows"]] == [*STAGES, "frame"] and "160 x 120" in said["machine"]
    assert said["batch"] == 4 and said["pictures_per_second"] > 0.0
    assert main([*words, "--batch", "0"]) == 2 and "--batch" in capsys.readouterr().err
    assert main([*words[:-1], "0"]) == 2 and "--frames" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["640", "0x480", "640x-1", "640x480x3", "9999x10", "axb"])
def test_invalid_image_size_is_rejected(text, capsys):
    assert main(["frame", "--size", text]) == 2
    assert "--size" in capsys.readouterr().err
    assert parse_image_size("1280X720") == (1280, 720)
