"""Windows of frames for other programs: decoded images, batches, and damaged files."""

import pickle
import struct

import h5py
import numpy as np
import pytest
from tiny_episodes import HEIGHT, SCALE, WIDTH, Wanted, packed, read_images, write_episode, write_three_episodes

from scenes import read_episodes
from scenes.episodes.reading.contents import FileCache
from sim.errors import InputError


@pytest.fixture(scope="module")
def folder(box, tmp_path_factory):
    return write_three_episodes(tmp_path_factory.mktemp("episodes"), box)


def test_windows_have_their_listed_frames_in_fixed_order(folder):
    found = read_episodes(folder, ["time", "tip", "tumour_rest"], window=3, step=2, stride=2)
    placed = [(one["episode"], one["frame"].tolist()) for one in found]
    assert placed == [(0, [0, 2, 4]), (0, [2, 4, 6]), (1, [0, 2, 4]), (1, [2, 4, 6]), (1, [4, 6, 8])]
    assert len(found) == 5 and found[-1]["frame"][0] == 4
    for one in found:
        assert np.allclose(one["time"], one["frame"] / 30.0) and one["tip"].shape == (3, 3)
        assert one["tumour_rest"].ndim == 2
    for beyond in (5, -6):
        with pytest.raises(IndexError):
            found[beyond]
    with pytest.raises(InputError, match="begin at 1"):
        found.get_window(2, 1)
    assert len(read_episodes(folder, ["time"], window=20)) == 0 and len(read_episodes(folder, ["time"], stride=3)) == 8


def test_decoded_images_match_drawn_images(folder, box):
    names = ("colour", "depth", "segmentation", "tumour_mask")
    window = read_episodes(folder, names, window=4).get_window(2, 0)
    at = read_episodes(folder, ["tumour_predicted"], window=4).get_window(2, 0)["tumour_predicted"]
    drawn = read_images(box, Wanted(4, seed=2), at)
    assert window["colour"].shape == (4, HEIGHT, WIDTH, 3) and window["colour"].dtype == np.uint8
    assert np.abs(window["colour"].astype(int) - drawn["colour"]).max() < 6  # red is red
    assert window["depth"].dtype == np.float32 and np.allclose(window["depth"], drawn["depth"] * SCALE, atol=1e-8)
    for name in names[2:]:
        assert window[name].dtype == np.uint8 and np.array_equal(window[name], drawn[name])


def test_unsolved_frames_are_nan(folder):
    window = read_episodes(folder, ["tumour_fem", "outcome_fem", "tumour_predicted"], window=5).get_window(1, 2)
    assert window["fem_known"].tolist() == [False, True, False, False, True]
    off = np.linalg.norm(window["tumour_fem"] - window["tumour_predicted"], axis=2)
    assert np.allclose(off[[1, 4]], 1e-4) and np.isnan(off[[0, 2, 3]]).all()
    assert window["outcome_fem"] == ["", "CONVERGED", "", "", "CONVERGED"]
    assert read_episodes(folder, ["tumour_fem"], window=2).get_window(1, 1)["fem_known"].tolist() == [False, False]
    assert read_episodes(folder, ["tumour_fem"], window=7).get_window(0, 0)["fem_known"].all()
    apart = read_episodes(folder, ["tumour_fem", "tumour_predicted"], window=2, step=6).get_window(1, 0)
    assert np.allclose(apart["tumour_fem"] - apart["tumour_predicted"], [0.0, 0.0, 1e-4])


def test_batches_are_stacked_and_shuffled_with_a_seed(folder, box, tmp_path):
    found = read_episodes(folder, ["tip"], window=2)
    plain, shuffled, again = (list(found.iterate_batches(4, seed)) for seed in (None, 3, 3))
    assert [len(one["episode"]) for one in plain] == [4, 4, 4, 4, 1] and plain[0]["tip"].shape == (4, 2, 3)
    assert np.array_equal(plain[1]["frame"][:, 0], [4, 5, 0, 1])
    assert all(np.array_equal(one["frame"], other["frame"]) for one, other in zip(shuffled, again, strict=True))
    assert any(not np.array_equal(one["frame"], other["frame"]) for one, other in zip(plain, shuffled, strict=True))
    wide = write_episode(tmp_path / "wide.h5", box, Wanted(4, width=48))
    with pytest.raises(InputError, match="'colour' has shapes"):
        next(read_episodes([folder, wide], ["colour"], stride=7).iterate_batches(9))


def test_episode_files_are_opened_on_reading_up_to_a_limit(folder):
    found = read_episodes(folder, ["time"], most_open=2)
    assert len(found.files) == 0
    for _ in found:
        assert 1 <= len(found.files) <= 2
    other = pickle.loads(pickle.dumps(found))
    assert len(other.files) == 0 and other.files.most == 2 and other[3]["frame"] == found[3]["frame"]
    with pytest.raises(InputError, match="at least one"):
        FileCache(0)


def test_unknown_episode_keys_are_rejected_by_name(folder):
    with pytest.raises(InputError, match=r"episode_000000.h5: has no 'fem_frames'. It has .*tumour_fem"):
        read_episodes(folder, ["fem_frames"])
    with pytest.raises(InputError, match="window 0"):
        read_episodes(folder, window=0)
    with pytest.raises(InputError, match="no such file"):
        read_episodes(folder / "none.h5")
    with pytest.raises(InputError, match="holds no episodes"):
        read_episodes(folder / "bodies")
    keys = read_episodes(folder).keys
    assert "colour" in keys and "outcome_fem" not in keys and "fem_frames" not in keys


def spoil(path, how):
    """Make one thing of a file wrong."""
    with h5py.File(path, "a") as file:
        how(file)


def test_damaged_image_is_rejected_with_frame_number(tmp_path, box):
    path = write_episode(tmp_path / "x.h5", box)
    bomb = bytearray(packed("depth", np.zeros((8, 8), np.uint16)).tobytes())
    bomb[16:24] = struct.pack(">II", 60_000, 60_000)
    spoil(path, lambda file: file["pictures/depth"].__setitem__(3, np.frombuffer(bytes(bomb), np.uint8)))
    found = read_episodes(path, ["depth"])
    assert found[2]["depth"].shape == (1, HEIGHT, WIDTH)
    with pytest.raises(InputError, match=r"'depth' of frame 3 cannot be decoded: it has 60000 x 60000 pixels"):
        found[3]
