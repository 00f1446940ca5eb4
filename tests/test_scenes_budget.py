"""`sulcus budget`: all parts of the overlay's error, and rejected input."""

import json

import pytest

from scenes.analysis.error_budget import CLINICAL
from scenes.cli import main
from scenes.script.uncertainty import SURROGATE
from sim.bodies.meshfile import write_anatomy


def test_budget_command_lists_all_parts_and_rejects_bad_input(box, tmp_path, capsys):
    body, own = tmp_path / "box.vtu", tmp_path / "brief.py"
    write_anatomy(body, box)
    own.write_text(
        "from scenes import Scene, press\n"
        "SCENE = Scene('brief', 'A short press.', press(0.25, rise=0.1, hold=0.0), duration=0.2)\n"
    )
    words = ["budget", str(own), "--anatomy", str(body), "--device", "cpu", "--draws", "8", "--samples", "200"]
    assert main([*words, "--twins", "1", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert set(said["parts"]) == {*CLINICAL, "technical", "clinical"} and said["bodies"] == 8
    assert said["parts"][SURROGATE]["worst_mm"]["p95"] == 0.0  # finite elements play
    row = said["parts"]["clinical"]
    assert row["across_mm"]["p50"] < row["across_mm"]["p95"] < row["worst_mm"]["p95"] == pytest.approx(said["band_mm"])
    assert 0.0 <= said["held_twins"] <= 1.0 and said["held_twins_off"] is None  # of one twin
    assert said["readout_ms"] == 0.0
    for more, why in (
        (["--path", "microscope"], "zooms"),
        (["--intrinsics", "k.json"], "give it by --camera"),
        (["--registration", "none.json"], "no such file"),
        (["--readout", "9000"], "--readout 9000: an image's rows"),
        (["--corner-noise", "-1"], "--corner-noise -1"),
        (["--samples", "10"], "--samples"),
    ):
        assert main([*words, *more]) == 2
        assert why in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["budget", "--help"])
    assert "palpate and retract take over 4 minutes" in " ".join(capsys.readouterr().out.split())
    assert main(["budget", "sag", *words[2:]]) == 2
    assert "estimates the tumour position" in capsys.readouterr().err
