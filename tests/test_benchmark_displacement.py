"""The benchmark that trains small networks on episodes, held against frames whose answer is a known function."""

import importlib
import json
import runpy
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from conftest import make_box
from scipy.spatial.transform import Rotation
from tiny_episodes import Wanted, write_episode

FOLDER = Path(__file__).parents[1] / "benchmarks" / "displacement_from_pictures"
MODULES = ("frames", "inputs", "networks", "neighbours", "errors", "extraction", "experiment", "tables")
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def parts():
    """Modules of the benchmark, by name; none of them stays behind."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FOLDER))
        yield {name: importlib.import_module(name) for name in MODULES}
        for name in MODULES:
            del sys.modules[name]


def made(parts, episodes=40, each=12, seed=0):
    """Frames whose tumour moves along the force, more under a picture that is bright; one body for three episodes."""
    draws = np.random.default_rng(seed)
    n = episodes * each
    pose = draws.normal(size=(n, len(parts["frames"].POSE))).astype(np.float32)
    force = draws.normal(size=(n, len(parts["frames"].FORCE))).astype(np.float32)
    bright = draws.integers(40, 200, (n, 1, 1, 1)).astype(np.uint8)
    picture = np.broadcast_to(bright, (n, 12, 16, 4)).copy()
    label = (0.5 * force[:, :3] * (1.0 + bright[:, 0, 0] / 200.0)).astype(np.float32)
    episode = np.repeat(np.arange(episodes), each)
    turn = Rotation.random(n, rng=draws).as_matrix().astype(np.float32)
    return parts["frames"].Frames(
        picture, pose, force, turn, label, label.copy(), np.ones(n, bool), episode, episode // 3, np.arange(n) % each,
        np.full(n, "press", "U16"),
    )  # fmt: skip


def test_a_network_finds_a_function_that_nearest_frames_do_not(parts):
    training, aside = parts["experiment"].split(made(parts), 40, seed=0)
    other, inputs = made(parts, seed=1), parts["inputs"].INPUTS[-1]
    how = parts["networks"].Training(updates=120, batch=48)
    network = parts["networks"].fitted(inputs, training, aside, 0, CPU, how)
    assert sum(weights.numel() for weights in network.network.parameters()) < 1_000_000
    nearest = parts["neighbours"].neighbours(inputs, training, aside, CPU)
    off = {
        name: np.median(parts["errors"].distances(answers, other.truth))
        for name, answers in {
            "zero": 0.0 * other.truth, "network": network.answers(other), "nearest": nearest.answers(other),
        }.items()
    }  # fmt: skip
    assert off["network"] < 0.5 * off["nearest"] < 0.5 * off["zero"]
    itself = replace(nearest, count=1)
    assert np.allclose(itself.answers(training), training.label, atol=1e-5)


def test_nearest_frames_do_not_care_how_the_camera_is_held(parts):
    frames, inputs = made(parts, 12), parts["inputs"].INPUTS[4]
    turned = Rotation.random(len(frames), rng=3).as_matrix().astype(np.float32)

    def turn(values, count):
        vectors = values[:, : 3 * count].reshape(len(values), count, 3)
        return np.concatenate(
            [np.einsum("nij,nkj->nki", turned, vectors).reshape(len(values), -1), values[:, 3 * count :]], 1
        )

    other = replace(
        frames,
        pose=turn(frames.pose, 5),
        force=turn(frames.force, 1),
        turn=turned @ frames.turn,
        label=turn(frames.label, 1),
    )
    found = replace(parts["neighbours"].neighbours(inputs, frames, frames, CPU), count=3)
    assert inputs.name == "pose, force"
    assert np.allclose(found.answers(other), turn(found.answers(frames), 1), atol=1e-4)


def test_a_mirrored_frame_is_a_frame_of_the_mirrored_world(parts):
    frames, inputs = made(parts, 2), parts["inputs"].INPUTS[-1]
    frames.picture[:] = np.random.default_rng(2).integers(0, 255, frames.picture.shape)
    scale = parts["inputs"].Scale.of(inputs, frames)
    picture, numbers, label = parts["networks"].tensors(inputs, scale, frames, CPU)
    turned = parts["inputs"].mirrored(inputs, scale, picture, numbers, label, torch.Generator().manual_seed(0))
    names, signs = list(inputs.names), (turned[2] / label).round().numpy()
    assert set(map(tuple, signs.tolist())) == {(a, b, 1.0) for a in (1.0, -1.0) for b in (1.0, -1.0)}
    raw, before = (scale.mean + scale.deviation * one.numpy() for one in (turned[1], numbers))
    for name in ("tool", "force", "opening_normal"):
        places = [names.index(f"{name}_{axis}") for axis in "xyz"]
        assert np.allclose(raw[:, places], signs * before[:, places], atol=1e-5)
    alone = [names.index(name) for name in ("focal", "tumour_radius", "force_known")]
    assert np.allclose(raw[:, alone], before[:, alone], atol=1e-5)
    for row, (x, y, _) in enumerate(signs):
        assert torch.equal(turned[0][row], picture[row, :, ::1, :].flip([d for d, s in ((2, x), (1, y)) if s < 0]))


def test_no_episode_is_in_two_sets(parts):
    pool = made(parts, 20, 3)
    pool.truth[::3] = np.nan
    pool.usable[1] = False
    odd = replace(made(parts, 4, 3), family=np.repeat(["press", "drain"], 6).astype("U16"))
    sets = parts["experiment"].sets_of(pool, 12, {"hard": odd})
    assert list(sets.tests) == ["same bodies", "hard, same motions", "hard, other motions"]
    assert sets.training.episodes.tolist() == list(range(12)) and len(sets.training) == 35
    assert sets.tests["same bodies"].episodes.tolist() == list(range(12, 20)) and len(sets.tests["same bodies"]) == 16
    for count in (4, 12):
        kept, aside = parts["experiment"].split(sets.training, count, seed=3)
        assert not set(kept.episodes) & set(aside.episodes) and len({*kept.episodes, *aside.episodes}) == count


def test_intervals_are_of_episodes_and_not_of_frames(parts):
    episode = np.repeat(np.arange(20), 30)
    off = np.random.default_rng(0).uniform(0.5, 1.5, 20)[episode][None]
    found = parts["errors"].errors_of(off, episode, episode // 10)
    as_frames = parts["errors"].errors_of(off, np.arange(600), episode // 10)
    width, narrow = (each.median.high - each.median.low for each in (found, as_frames))
    assert width > 3.0 * narrow and found.median.low <= found.median.value <= found.median.high
    assert found.bodies == tuple(sorted(np.median(off[0, half]) for half in (slice(300), slice(300, None))))


@pytest.fixture
def episode(tmp_path):
    """As plans make them: with tracked poses, a force that is read, and the cortex; solved in frames 0, 3 and 6."""
    box = make_box(cells=(5, 5, 4), spacing=1e-2, opening=0.03)
    path = write_episode(tmp_path / "episode_000007.h5", box, Wanted(7, every=3))
    with h5py.File(path, "a") as file:
        file.attrs.update(
            {"plan": 'title = "T"\nsolved_every = 3\n[motion.press]', "episode": 7, "body": 2, "footprint_m": 6e-3}
        )
        for name in ("T_world_tool", "T_camera_world"):
            file[f"{name}_tracked"] = file[name][:]
        file["force_read"] = file["force"][:] * 1.5
        file["tumour_left"] = np.ones(file["tumour_predicted"].shape[:2], bool)
        file["outcome_predicted"] = np.array(["PREDICTED"] * 6 + ["EXTRAPOLATED"], h5py.string_dtype())
        file["cortex_rest"] = box.mesh.nodes[np.unique(box.open_surface)]
    return path


def test_what_is_measured_is_in_the_cameras_axes(parts, episode):
    frames = parts["extraction"].frames_of(episode, 1, 20)
    assert frames.picture.shape == (7, 15, 20, 4) and frames.episode[0] == 7 and frames.body[0] == 2
    assert frames.tested.tolist() == [False, False, False, True, False, False, True]
    assert frames.usable.tolist() == [True] * 6 + [False]
    with h5py.File(episode) as file:
        camera, rest = file["T_camera_world"][0], file["tumour_rest"][:]
        shift = 1e3 * (file["tumour_fem"][1] - rest).mean(axis=0) @ camera[:3, :3].T
        assert np.allclose(frames.truth[3], shift, atol=1e-6)
        tool = 1e3 * camera[:3, :3] @ (file["T_world_tool"][4, :3, 3] - rest.mean(axis=0))
        named = dict(zip(parts["frames"].POSE, frames.pose[4], strict=True))
        assert np.allclose([named[f"tool_{axis}"] for axis in "xyz"], tool, atol=1e-4)
        assert named["tumour_z"] == pytest.approx(300.0) and named["opening_normal_z"] == pytest.approx(-1.0)
        assert np.allclose(frames.force[4, :3], 1.5 * camera[:3, :3] @ file["force"][4], atol=1e-6)


def test_no_truth_is_among_what_is_measured(parts, episode):
    before = parts["extraction"].frames_of(episode, 1, 20)
    truths = ("T_world_tool", "T_camera_world", "tip", "force", "distance", "tumour_predicted", "tumour_fem")
    with h5py.File(episode, "a") as file:
        for name in truths:
            file[name][:] = np.random.default_rng(0).normal(size=file[name].shape)
    after = parts["extraction"].frames_of(episode, 1, 20)
    assert not np.allclose(before.label, after.label)
    for name in ("picture", "pose", "force"):
        assert np.array_equal(getattr(before, name), getattr(after, name)), name


def test_episodes_of_no_plan_are_named(parts, episode, capsys):
    main = runpy.run_path(str(FOLDER / "__main__.py"), run_name="benchmark")["main"]
    given = [
        "extract",
        str(episode.parent),
        "--workers",
        "1",
        "--width",
        "20",
        "--out",
        str(episode.with_suffix(".npz")),
    ]
    assert main([*given, "--first", "8"]) == 2 and "no episode of these numbers" in capsys.readouterr().err
    with h5py.File(episode, "a") as file:
        del file.attrs["plan"]
    assert main(given) == 2 and "states no plan" in capsys.readouterr().err


def test_frames_come_back_and_tables_are_printed(parts, tmp_path, capsys):
    frames = made(parts, 10, 4)
    frames.truth[0] = np.nan
    parts["frames"].write_frames(tmp_path / "a.npz", frames)
    read = parts["frames"].read_frames([tmp_path / "a.npz"])
    for name, value in vars(frames).items():
        assert np.array_equal(getattr(read, name), value, equal_nan=value.dtype.kind == "f"), name
    main = runpy.run_path(str(FOLDER / "__main__.py"), run_name="benchmark")["main"]
    given = ["train", "--train", str(tmp_path / "a.npz"), "--training", "7", "--sizes", "5", "--seeds", "1"]
    assert main([*given, "--updates", "1", "--batch", "4", "--device", "cpu", "--json", str(tmp_path / "b.json")]) == 0
    shown = capsys.readouterr().out
    assert (
        "| same bodies | network | picture, pose |" in shown and "| tested on | answered by | given | 5 | 7 |" in shown
    )
    assert main(["show", str(tmp_path / "b.json")]) == 0 and capsys.readouterr().out == shown
    rows = json.loads((tmp_path / "b.json").read_text())["rows"]
    assert len(rows) == 3 + 2 * 6 + 3 and {row["episodes"] for row in rows} == {5, 7}
    assert main(["train", "--train", str(tmp_path / "b.json"), "--training", "7"]) == 2
    assert "Extract it anew" in capsys.readouterr().err
