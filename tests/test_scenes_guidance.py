"""What the command line says before, while and after it works."""

import argparse
from dataclasses import replace
from types import SimpleNamespace

import nibabel
import numpy as np
import pytest
import warp as wp
from balls import ball
from plain_english import too_long
from theatres import put, theatre_of

from ar.screen import read_png
from benchmarks.__main__ import BENCHMARKS, make_parser
from scenes.cli import COMMANDS, main, make_parsers, with_points
from scenes.commands.guidance import EXAMPLES, NAMES, PLAYING
from scenes.commands.train import notes_on
from scenes.options.placement_options import opened
from scenes.play.reference import truth_of
from scenes.script.scene import SCENES
from sim.bodies.label_volume import volume_subject
from sim.errors import InputError
from sim.loads import push
from sim.runtime.device import find_device
from sim.runtime.journal import opened as opened_journal


def helped(words, capsys):
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 0
    return capsys.readouterr().out


def test_the_version_is_reported(capsys):
    assert helped(["--version"], capsys).startswith("sulcus 0.")


def arguments_of(name, parser):
    """Each argument of a command and of the commands in it: its name, and the help for it."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for inner, command in action.choices.items():
                yield from arguments_of(f"{name} {inner}", command)
        else:
            yield f"{name} {(*action.option_strings, action.dest)[0]}", action.help


def test_every_argument_of_every_command_has_help_in_short_sentences():
    parsers = {**make_parsers(*COMMANDS)[1], "benchmarks": make_parser(*BENCHMARKS)}
    known = dict(each for name, parser in parsers.items() for each in arguments_of(name, parser))
    assert len(known) > 200 and "solve --precision" in known and "benchmarks live --frames" in known
    assert not [name for name, text in known.items() if not (text or "").strip()]
    # A default alone does not say what it is of.
    assert not [name for name, text in known.items() if text.startswith("(")]
    assert not {name: long for name, text in known.items() if (long := too_long(text))}


@pytest.mark.parametrize("name", COMMANDS)
def test_every_help_has_examples_that_parse_and_says_what_next(name, capsys, monkeypatch):
    text = helped([name, "--help"], capsys)
    assert "next: " in text and set(EXAMPLES) == set(COMMANDS)
    examples = [line.split()[1:] for line in EXAMPLES[name].splitlines() if line.startswith("  sulcus ")]
    assert any(words[0] == name for words in examples)
    monkeypatch.setattr("argparse.ArgumentParser.error", lambda self, message: pytest.fail(message))
    for words in examples:
        monkeypatch.setattr(f"scenes.commands.{words[0]}.run", lambda args: 0)
        assert main(words) == 0
    assert (NAMES in text) == (name in PLAYING)


def test_scenes_are_those_that_there_are():
    assert tuple(NAMES.split(", ")) == SCENES


def test_a_point_may_begin_with_a_minus():
    assert with_points(["--opening-at", "-3,4.5,-6", "--nodes", "-3"]) == ["--opening-at=-3,4.5,-6", "--nodes", "-3"]
    assert with_points(["--out", "-x", "-1,2,3"]) == ["--out", "-x", "-1,2,3"]


def test_training_says_what_takes_long_and_what_too_few_loads_cannot_give():
    few, many = (SimpleNamespace(good=np.ones(count, bool)) for count in (20, 76))
    series, bounds = notes_on(few, ["linear", "series-gp"])
    assert "minutes on a CPU" in series and "of 20 loads 5 are kept" in bounds and "--count 76" in bounds
    assert notes_on(many, ["linear"]) == []


@pytest.mark.parametrize("learners", ["", "linear,,svr", " "])
def test_learners_without_a_name_are_a_sentence(learners, tmp_path, capsys):
    assert main(["train", "none.h5", "--out", str(tmp_path / "m.npz"), "--learners", learners]) == 2
    assert "name each learner" in capsys.readouterr().err


def test_it_is_said_why_there_is_no_cuda():
    if wp.is_cuda_available():
        pytest.skip("there is")
    with pytest.raises(InputError, match="no NVIDIA driver"):
        find_device("cuda", "float32")


def test_whoever_waits_for_the_truth_sees_it_go_by(pretender):
    theatre = SimpleNamespace(fem=lambda scene, accuracy, batch: pretender)
    loads = [push(np.array([0.001 * k, 0.0, 0.0]), np.array([0.0, 0.0, -0.1]), 6e-3) for k in range(20)]
    heard = []
    found = truth_of(theatre, None, loads, heard.append)
    assert heard == [16, 4]
    alone = np.concatenate([pretender.deform(load).displacement for load in loads])
    np.testing.assert_allclose(found.displacement, alone, atol=1e-12)


@pytest.fixture(scope="module")
def folder(box, tmp_path_factory):
    folder = tmp_path_factory.mktemp("guided")
    put(theatre_of(box), folder / "box.vtu")
    return folder


def test_frames_that_are_there_are_kept_or_removed_by_force(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    words = ["render", "press", "--anatomy", "box.vtu", "--device", "cpu", "--out", str(tmp_path), "--plain"]
    assert main([*words, "--every", "60", "--film", str(tmp_path / "press.gif")]) == 0
    assert f"film {tmp_path / 'press.gif'}" in capsys.readouterr().out
    first = {path: path.read_bytes() for path in tmp_path.glob("frame_*.png")}
    assert len(first) == 3
    assert all(read_png(path).shape == (600, 800, 3) for path in first)
    (tmp_path / "frame_mine.png").write_bytes(b"mine")
    assert main([*words, "--every", "120"]) == 2
    assert "holds 3 frames. Give --force" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in first} == first
    assert main([*words, "--every", "120", "--force"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "frame_0000.png", "frame_0120.png", "frame_mine.png", "press.gif",
    ]  # fmt: skip


def test_checking_shows_how_far_it_is(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main(["check", "press", "--anatomy", "box.vtu", "--device", "cpu", "--every", "60"]) in (0, 1)
    assert "press: " in capsys.readouterr().err


def two_foci(folder):
    """A head with a tumour of 10 mm radius on the right, and one of 6 mm on the left, in front."""
    ball(folder)
    image = nibabel.load(folder / "labels.nii.gz")
    labels = np.asarray(image.dataobj).copy()
    places = 2.0 * (np.moveaxis(np.indices((64, 64, 64)), 0, -1) - 31.5)
    labels[np.linalg.norm(places - [-25.0, 25.0, 20.0], axis=-1) < 6.0] = 2
    nibabel.save(nibabel.Nifti1Image(labels, image.affine), folder / "labels.nii.gz")


def test_the_skull_is_opened_over_the_piece_that_is_asked_for(tmp_path):
    two_foci(tmp_path)
    subject = volume_subject(tmp_path / "labels.nii.gz", (1,), (2,))
    large, small = subject.pieces
    assert large.volume > 3.0 * small.volume and large.centre[0] > 0.0 > small.centre[0]
    asked = dict.fromkeys(("opening_at", "opening_over"))
    site = opened(subject, SimpleNamespace(**asked)).site
    assert site[0] > 0.0 and site @ large.centre > 0.99 * np.linalg.norm(site) * np.linalg.norm(large.centre)
    site = opened(subject, SimpleNamespace(**asked | {"opening_over": 2})).site
    assert site @ small.centre > 0.99 * np.linalg.norm(site) * np.linalg.norm(small.centre)
    at = opened(subject, SimpleNamespace(**asked | {"opening_at": (-50.0, 0.0, 20.0)})).site
    assert np.linalg.norm(at - [-0.05, 0.0, 0.02]) < 5e-3
    site = opened(subject, SimpleNamespace(**asked | {"opening_over": (-25.0, 25.0, 20.0)})).site
    assert site[0] < -0.02 and site[1] > 0.02
    with pytest.raises(InputError, match=r"lies \d+ mm outside the brain"):
        opened(subject, SimpleNamespace(**asked | {"opening_over": (-90.0, 0.0, 20.0)}))
    with pytest.raises(InputError, match="has 2 pieces: choose 1 to 2"):
        opened(subject, SimpleNamespace(**asked | {"opening_over": 3}))
    with pytest.raises(InputError, match="has one piece: give no number"):
        opened(replace(subject, pieces=(large,)), SimpleNamespace(**asked | {"opening_over": 2}))


def test_an_anatomy_says_where_its_pieces_lie_and_refuses_to_leave_data_behind(tmp_path, capsys):
    two_foci(tmp_path)
    out = tmp_path / "me.vtu"
    words = ["anatomy", "--labels", str(tmp_path / "labels.nii.gz"), "--brain", "1", "--tumour", "2", "--nodes", "2000"]
    words += ["--opening-over", "-25,25,20", "--out", str(out)]
    assert main(words) == 0
    said, noted = capsys.readouterr()
    assert "holds 8.7 % less tumour than" in noted and "ask for more nodes" in noted
    assert "2 pieces; the skull is opened over the point given" in said and "piece 2: 0.88 ml, left anterior" in said
    assert "opening: left anterior superior" in said
    with opened_journal(tmp_path / "me.h5.partial", {"anatomy": "of another"}):
        pass
    assert main(words) == 2 and "me.vtu: exists. Give --force" in capsys.readouterr().err
    out.rename(tmp_path / "other.vtu")
    assert main(words) == 2
    assert "me.h5.partial" in (error := capsys.readouterr().err) and "--force" in error and not out.exists()


def test_a_patient_hands_force_and_opening_on_and_begins_nothing_that_it_cannot_end(tmp_path, monkeypatch, capsys):
    steps = []
    monkeypatch.setattr("scenes.cli.main", lambda words: steps.append(words) or 0)
    words = ["patient", "labels.nii.gz", "--brain", "1", "--tumour", "2", "--device", "cpu"]
    words += ["--out", str(tmp_path / "me.vtu")]
    assert main([*words, "--force", "--opening-at", "-30,1.5,60"]) == 0
    assert all("--force" in step for step in steps) and "--opening-at=-30.0,1.5,60.0" in steps[0]
    steps.clear()
    (tmp_path / "me.model.npz").write_bytes(b"mine")
    assert main(words) == 2 and not steps
    assert "me.model.npz" in capsys.readouterr().err and not (tmp_path / "me.vtu.partial").exists()


def test_a_stopped_patient_goes_on_after_the_steps_that_are_done(tmp_path, monkeypatch, capsys):
    steps, codes = [], {"anatomy": 2, "simulate": 130, "train": 0}
    made = {"anatomy": "me.vtu", "simulate": "me.h5", "train": "me.model.npz"}

    def step(words):
        steps.append(words[0])
        if codes[words[0]] == 0:
            (tmp_path / made[words[0]]).write_bytes(b"made")
        return codes[words[0]]

    monkeypatch.setattr("scenes.cli.main", step)
    words = ["patient", "labels.nii.gz", "--brain", "1", "--tumour", "2", "--device", "cpu"]
    words += ["--out", str(tmp_path / "me.vtu")]
    assert main(words) == 2 and not list(tmp_path.iterdir())
    codes["anatomy"] = 0
    assert main(words) == 130 and (tmp_path / "me.vtu.partial").exists()
    assert main([*words, "--nodes", "2000"]) == 2 and "was begun with anatomy" in capsys.readouterr().err
    codes["simulate"] = 0
    assert main(words) == 0
    assert steps == ["anatomy", "anatomy", "simulate", "simulate", "train"]
    assert {path.name for path in tmp_path.iterdir()} == set(made.values())
    assert main(words) == 2 and "me.vtu: exists. Give --force" in capsys.readouterr().err
