"""Messages of the command line: help, examples, progress and missing CUDA."""

import argparse

import pytest
import warp as wp

from benchmarks.__main__ import BENCHMARKS, make_parser
from scenes.cli import COMMANDS, join_points, main, make_parsers
from scenes.commands.guidance import EXAMPLES, NAMES, PLAYING_COMMANDS
from scenes.script.scene import SCENES
from sim.errors import InputError
from sim.runtime.device import find_device


def helped(words, capsys):
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 0
    return capsys.readouterr().out


def test_version_option_prints_the_version(capsys):
    assert helped(["--version"], capsys).startswith("sulcus 0.")


def arguments_of(name, parser):
    """Each argument of a command and of the commands in it: its name, and the help for it."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for inner, command in action.choices.items():
                yield from arguments_of(f"{name} {inner}", command)
        else:
            yield f"{name} {(*action.option_strings, action.dest)[0]}", action.help


def test_each_argument_of_each_command_has_help():
    parsers = {**make_parsers(*COMMANDS)[1], "benchmarks": make_parser(*BENCHMARKS)}
    known = dict(each for name, parser in parsers.items() for each in arguments_of(name, parser))
    assert len(known) > 200 and "solve --precision" in known and "benchmarks live --frames" in known
    assert not [name for name, text in known.items() if not (text or "").strip()]
    # A default alone does not say what it is of.
    assert not [name for name, text in known.items() if text.startswith("(")]


@pytest.mark.parametrize("name", COMMANDS)
def test_each_help_has_valid_examples_and_next_step(name, capsys, monkeypatch):
    text = helped([name, "--help"], capsys)
    assert "next: " in text and set(EXAMPLES) == set(COMMANDS)
    examples = [line.split()[1:] for line in EXAMPLES[name].splitlines() if line.startswith("  sulcus ")]
    assert any(words[0] == name for words in examples)
    monkeypatch.setattr("argparse.ArgumentParser.error", lambda self, message: pytest.fail(message))
    for words in examples:
        monkeypatch.setattr(f"scenes.commands.{words[0]}.run", lambda args: 0)
        assert main(words) == 0
    assert (NAMES in text) == (name in PLAYING_COMMANDS)


def test_scene_names_in_help_match_the_scenes():
    assert tuple(NAMES.split(", ")) == SCENES


def test_point_option_accepts_negative_coordinates():
    assert join_points(["--opening-at", "-3,4.5,-6", "--nodes", "-3"]) == ["--opening-at=-3,4.5,-6", "--nodes", "-3"]
    assert join_points(["--out", "-x", "-1,2,3"]) == ["--out", "-x", "-1,2,3"]


def test_find_device_reports_reason_for_missing_cuda():
    if wp.is_cuda_available():
        pytest.skip("there is")
    with pytest.raises(InputError, match="no NVIDIA driver"):
        find_device("cuda", "float32")


def test_check_command_shows_progress(box_folder, monkeypatch, capsys):
    monkeypatch.chdir(box_folder)
    assert main(["check", "press", "--anatomy", "box.vtu", "--device", "cpu", "--every", "60"]) in (0, 1)
    assert "press: " in capsys.readouterr().err
