"""`sulcus episodes`: rejected input, interruption, data sheet and script for a cluster."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest
from tiny_episodes import write_episode
from tiny_work import tiny_run

from scenes.cli import main
from scenes.episodes.engine import write_sbatch_script
from scenes.episodes.plan import load_plan
from scenes.episodes.run_folder import Failure, begin_run, mark_failed, remove_failure


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["none"], "there is no plan 'none': choose"),
        (["small", "--scheduler", "tcp://127.0.0.1:9x"], "no Dask scheduler at this address"),
        (["small", "--estimate"], "no episode was measured there"),
        (["small", "--slurm", "2"], "give --device cpu, or --device cuda"),
        (["small", "--slurm", "2", "--device", "cpu", "--workers", "2"], "leave --workers and --scheduler out"),
    ],
)
def test_episodes_command_rejects_bad_input_and_writes_nothing(words, said, tmp_path, capsys):
    out = tmp_path / "data"
    assert main(["episodes", *words, "--count", "2", "--out", str(out)]) == 2
    assert said in (error := capsys.readouterr().err) and error.count("\n") == 1
    assert not out.exists()


@pytest.mark.parametrize("words", [["--count", "0"], ["--count", "2.5"], ["--count", "2", "--first", "-1"]])
def test_episodes_command_rejects_non_integer_counts(words, tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["episodes", "small", *words, "--out", str(tmp_path / "data")])
    assert "is no whole number from" in capsys.readouterr().err


def test_folder_of_another_seed_is_rejected(tmp_path, capsys):
    digest = load_plan("small").digest
    begin_run(tmp_path, tiny_run(digest=digest), "")
    assert main(["episodes", "small", "--count", "1", "--seed", "7", "--out", str(tmp_path), "--workers", "1"]) == 2
    assert "Give --seed 1" in capsys.readouterr().err


def test_finished_run_has_a_data_sheet(box, tmp_path, capsys):
    folder, begun = tmp_path / "data", tiny_run(digest=load_plan("small").digest)
    begin_run(folder, begun, "")
    words = ["episodes", "small", "--count", "2", "--seed", "1", "--out", str(folder), "--workers", "1", "--json"]
    for number in range(2):
        mark_failed(folder, Failure(number, "no", lost=False))
    assert main(words[:-1]) == 1 and capsys.readouterr().out.endswith("Episode 0: no\n")
    assert main(words) == 1 and not json.loads(capsys.readouterr().out)["card"]
    assert not (folder / "DATASHEET.md").exists()
    write_episode(folder / "episode_000000.h5", box)
    remove_failure(folder, 0)
    held = (folder / "episode_000000.h5").read_bytes()
    assert main(words) == 1 and json.loads(capsys.readouterr().out)["card"]
    assert "| all | 1 |" in (sheet := (folder / "DATASHEET.md").read_text()) and "1 could not be made" in sheet
    (folder / "croissant.json").write_text("mine")
    write_episode(folder / "episode_000001.h5", box)
    remove_failure(folder, 1)
    assert main(words) == 0 and "is not of a card" in capsys.readouterr().err
    assert (folder / "croissant.json").read_text() == "mine" and (folder / "episode_000000.h5").read_bytes() == held


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_stops_processes_and_keeps_resumable_work(number, tmp_path):
    command = [sys.executable, "-m", "scenes.cli", "episodes", "small", "--count", "5", "--workers", "1"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    folder = tmp_path / "data"
    client = subprocess.Popen(
        [*command, "--out", str(folder)], stderr=subprocess.PIPE, text=True, env=environment, start_new_session=True
    )
    try:
        deadline = time.monotonic() + 60
        while not (folder / "rates").exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        os.killpg(client.pid, number) if number == signal.SIGINT else client.send_signal(number)
        error = client.communicate(timeout=20)[1]
    finally:
        client.kill()
    # Python ends itself by SIGINT where the interrupt met a string that was executed: shells say 130 of both.
    assert client.returncode in (130, -signal.SIGINT), error
    assert "run the same command again to resume in" in error and "Traceback" not in error, error
    assert (folder / "run.json").exists() and not list(folder.glob("episode_*"))


def test_slurm_script_starts_one_command_on_each_machine(tmp_path, capsys):
    """Run by bash, with a program that prints its arguments."""
    words = ["episodes", "small", "--count", "9", "--out", str(tmp_path / "a b"), "--device"]
    assert main([*words, "cuda", "--slurm", "3"]) == 0
    text = capsys.readouterr().out
    assert "#SBATCH --array=1-3\n" in text and "#SBATCH --gpus-per-task=1\n" in text
    assert text.endswith(' --workers "$((SLURM_CPUS_PER_TASK * 3 / 2))"\n') and "#SBATCH --mem-per-cpu=5G\n" in text
    assert f"exec {sys.executable} -m scenes.cli episodes small" in text and not (tmp_path / "a b").exists()
    program = [sys.executable, "-c", "import sys, json; print(json.dumps(sys.argv[1:]))", "--out", "a b"]
    environment = {**os.environ, "SLURM_CPUS_PER_TASK": "16"}
    for device, workers in (("cuda", "24"), ("cpu", "16")):
        script = write_sbatch_script(program, 4, device, "mine")
        done = subprocess.run(["bash"], input=script, capture_output=True, text=True, env=environment, check=True)
        assert json.loads(done.stdout) == ["--out", "a b", "--workers", workers]
    assert script.startswith("#!/bin/bash\n#SBATCH --job-name=mine\n") and "--requeue" in script
