"""Robomimic data sets of `sulcus convert`: read and trained on by robomimic."""

import json
import os
import subprocess

import h5py
import numpy as np
import pytest
from tiny_episodes import HEIGHT, WIDTH, Wanted, write_episode

from scenes import read_episodes
from scenes.cli import main
from scenes.episodes.exports.columns import build_twists

ROBOMIMIC = os.environ.get("SULCUS_ROBOMIMIC_PYTHON")
"""A Python that has robomimic."""
READ = """
import sys
import h5py
import numpy as np
import torch
import robomimic.utils.file_utils as files
import robomimic.utils.obs_utils as observations
from robomimic.algo import algo_factory
from robomimic.config import config_factory
from robomimic.utils.dataset import SequenceDataset

path, out = sys.argv[1:]
low, rgb, depth = ["tool_position", "tool_quaternion", "force"], ["colour_image"], ["depth_image"]
config = config_factory("bc")
with config.values_unlocked():
    config.observation.modalities.obs.low_dim = low
    config.observation.modalities.obs.rgb = rgb
    config.observation.modalities.obs.depth = depth
    config.train.batch_size = 4
observations.initialize_obs_utils_with_config(config)
shapes = files.get_shape_metadata_from_dataset(path, all_obs_keys=low + rgb + depth)
sets = {
    name: SequenceDataset(
        hdf5_path=path, obs_keys=low + rgb + depth, dataset_keys=["actions", "rewards", "dones"], seq_length=1,
        hdf5_cache_mode=None, filter_by_attribute=name, load_next_obs=False,
    )
    for name in ("train", "valid")
}
model = algo_factory("bc", config, shapes["all_shapes"], shapes["ac_dim"], torch.device("cpu"))
losses = []
for epoch in range(3):
    for batch in torch.utils.data.DataLoader(sets["train"], batch_size=4):
        asked = model.process_batch_for_training(batch)
        asked = model.postprocess_batch_for_training(asked, obs_normalization_stats=None)
        losses.append(model.train_on_batch(asked, epoch)["losses"]["action_loss"].item())
item = sets["train"][2]
np.savez(out, losses=losses, counts=[len(each) for each in sets.values()], actions=item["actions"], **item["obs"],
         kind=files.get_env_metadata_from_dataset(path)["type"])
"""


@pytest.mark.skipif(ROBOMIMIC is None, reason="needs SULCUS_ROBOMIMIC_PYTHON, a Python with robomimic")
def test_robomimic_reader_agrees_and_trains(box, tmp_path):
    for number, (frames, family) in enumerate(((7, "press"), (9, "slide"))):
        write_episode(tmp_path / f"in/episode_{number:06d}.h5", box, Wanted(frames, 3, number, family))
    path, out = tmp_path / "set.hdf5", tmp_path / "read.npz"
    assert main(["convert", str(tmp_path / "in"), "--to", "robomimic", "--out", str(path)]) == 0
    words = [str(ROBOMIMIC), "-c", READ, str(path), str(out)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    ours = read_episodes(tmp_path / "in", ["colour", "depth", "T_world_tool", "force"]).get_window(0, 2)
    with np.load(out) as read:
        assert read["counts"].tolist() == [7, 9] and np.isfinite(read["losses"]).all() and len(read["losses"]) == 6
        assert np.array_equal(read["colour_image"], ours["colour"]) and ours["colour"].shape[1:3] == (HEIGHT, WIDTH)
        assert np.allclose(read["depth_image"][..., 0], ours["depth"])
        assert np.allclose(read["tool_position"], ours["T_world_tool"][:, :3, 3]) and read["actions"].shape == (1, 6)
        assert np.allclose(read["force"], ours["force"])


def test_robomimic_has_demonstrations_and_holds_one_out(folder, tmp_path, capsys):
    out = tmp_path / "set.hdf5"
    words = ["convert", str(folder), "--to", "robomimic", "--out", str(out), "--json"]
    assert main(words) == 0 and main(words) == 2 and main([*words, "--force"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["held_out"] == 1
    ours = read_episodes(folder, ["depth", "colour", "T_world_tool"], window=7).get_window(0, 0)
    with h5py.File(out) as file:
        demo = file["data/demo_0"]
        assert "RAS [m]" in file["data"].attrs["space"]
        assert file["data"].attrs["total"] == 16 and "env_name" in json.loads(file["data"].attrs["env_args"])
        assert list(file["mask/train"]) == [b"demo_0"] and list(file["mask/valid"]) == [b"demo_1"]
        assert demo.attrs["num_samples"] == 7 and demo["dones"][:].tolist() == [0] * 6 + [1]
        assert np.array_equal(demo["obs/colour_image"], ours["colour"])
        assert np.array_equal(demo["obs/depth_image"][..., 0], ours["depth"])
        assert np.allclose(demo["actions"], build_twists(ours["T_world_tool"]))
        assert {len(demo[name]) for name in ("states", "rewards", "obs/tip", "obs/tumour_predicted")} == {7}
    out.write_text("mine")
    assert main(words) == 2 and out.read_text() == "mine"
