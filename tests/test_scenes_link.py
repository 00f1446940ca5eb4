"""Command of the live link: local server, measured solution, and rejected options."""

import signal
import socket
import subprocess
import sys
import time

import pytest
from films import FILM
from programs import main

from scenes.link.frame import HEADER, read_header
from scenes.play.deformers import to_model_path
from scenes.script.shipped_files import get_template_path

SELF = "localhost", "127.0.0.1", socket.gethostname()


def test_link_server_is_local_and_stops_on_signal():
    words = ["link", get_template_path(), "--tool", FILM / "tool.json", "--deformer", "rest", "--port", "0"]
    command = [sys.executable, "-m", "scenes.cli", *map(str, words), "--device", "cpu"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        address = next(line for line in process.stdout if "serves" in line).split()[2]
        assert address.startswith("127.0.0.1:")
        with socket.create_connection(address.split(":"), timeout=10) as one:
            assert read_header(one.recv(HEADER.size, socket.MSG_WAITALL)).name == "TumourInScan"
            process.send_signal(signal.SIGINT)
            _, error = process.communicate(timeout=20)
            said = b""
            while some := one.recv(1 << 16):
                said += some
        assert b"the server ends" in said
    finally:
        process.kill()
    assert process.returncode == 0 and "Traceback" not in error, error


@pytest.mark.parametrize(("delay", "said"), [(0.0, ""), (0.1, "--stale 0.3 is too short for solutions that take 0.2")])
def test_link_command_measures_one_solution(follower, monkeypatch, capsys, delay, said):
    class Slow:
        def deform(self, loads, start=None, at=None):
            time.sleep(delay)
            return follower.motion.deformer.deform(loads)

    monkeypatch.setattr("scenes.commands.link.build_requested_deformer", lambda *words: (Slow(), "a slow one"))
    words = ["--tool", FILM / "tool.json", "--port", "0", "--device", "cpu", "--seconds", "0.1"]
    assert main(["link", str(get_template_path()), *map(str, words)]) == 0
    out, error = capsys.readouterr()
    assert "one solution takes" in out and said in error and ("too short" in error) == bool(said)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--port", "70000"], "--port 70000"),
        (["--stale", "0"], "--stale 0"),
        (["--tool-name", "N\u00e4del"], "--tool-name 'N\u00e4del': must be of printable"),
        (["--camera-name", " "], "--camera-name ' '"),
        (["--tool-name", "StylusTipToReferenceA", "--camera-name", "StylusTipToReferenceB"], "their first 20"),
        (["--tracking-noise", "-1"], "--tracking-noise -1"),
        (["--client", ":18944"], "--client :18944"),
        *((["--client", host], f"--client {host}: port 18944 of this machine") for host in SELF),
        (["--registration", "none.json"], "none.json: no such file"),
        (["--model", str(to_model_path(get_template_path()))], "no model next to"),
        (
            ["--host", "198.51.100.1", "--tool", str(FILM / "tool.json"), "--deformer", "rest"],
            "no server on 198.51.100.1",
        ),
    ],
)
def test_link_command_rejects_invalid_options(words, why, capsys):
    assert main(["link", str(get_template_path()), "--device", "cpu", *words]) == 2
    assert why in capsys.readouterr().err


def test_link_benchmark_rejects_rate_of_zero(capsys):
    assert main(["benchmarks", "link", "--rate", "0"]) == 2
    assert "--rate and --seconds" in capsys.readouterr().err
