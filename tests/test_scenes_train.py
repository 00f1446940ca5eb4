"""Command that trains models: notes on time and on too few loads."""

from types import SimpleNamespace

import numpy as np
import pytest

from scenes.cli import main
from scenes.commands.train import list_notes


def test_train_notes_warn_of_slow_learners_and_few_loads():
    few, many = (SimpleNamespace(good=np.ones(count, bool)) for count in (20, 76))
    series, bounds = list_notes(few, ["linear", "series-gp"])
    assert "minutes on a CPU" in series and "of 20 loads 5 calibrate error bounds" in bounds and "--count 76" in bounds
    assert list_notes(many, ["linear"]) == []


@pytest.mark.parametrize("learners", ["", "linear,,svr", " "])
def test_train_command_rejects_empty_learner_name(learners, tmp_path, capsys):
    assert main(["train", "none.h5", "--out", str(tmp_path / "m.npz"), "--learners", learners]) == 2
    assert "name each learner" in capsys.readouterr().err
