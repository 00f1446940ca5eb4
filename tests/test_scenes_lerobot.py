"""LeRobot data sets: layout, images and statistics equal those of the episodes."""

import json
import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest
from test_scenes_columns import poses_after
from test_scenes_croissant import FOREIGN
from tiny_episodes import HEIGHT, WIDTH

from scenes import read_episodes
from scenes.cli import main
from scenes.episodes.exports.columns import TASKS
from scenes.episodes.exports.lerobot import RowStatistics

READ = """
import sys
import numpy as np
from datasets import Image, load_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset
root = sys.argv[1]
data = LeRobotDataset("sulcus/set", root=root, delta_timestamps={"action": [0.0, 1 / 30]})
item = data[9]
depth = item["observation.images.depth"].numpy()[0].astype(np.int64) & 0xFFFF
rows = load_dataset("parquet", data_files=f"{root}/data/*/*.parquet", split="train", cache_dir=sys.argv[2])
picture = rows.cast_column("observation.images.colour", Image())[9]["observation.images.colour"]
np.savez(sys.argv[3], depth=depth, colour=item["observation.images.colour"], action=item["action"], count=len(data),
         tumour=item["observation.tumour_predicted"], task=item["task"], picture=np.asarray(picture))
"""


@pytest.fixture(scope="module")
def lerobot(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("lerobot") / "set"
    assert main(["convert", str(folder), "--to", "lerobot", "--out", str(out)]) == 0
    return out


def test_lerobot_export_has_layout_and_original_image_bytes(lerobot, folder):
    info = json.loads((lerobot / "meta/info.json").read_text())
    assert "RAS [m]" in json.loads((lerobot / "meta/spaces.json").read_text())["spaces"]
    assert info["codebase_version"] == "v3.0" and info["fps"] == 30 and info["total_frames"] == 16
    depth = info["features"]["observation.images.depth"]
    assert depth["shape"] == [HEIGHT, WIDTH, 1] and depth["info"]["range_m"] == [0.1, 0.6]
    table = pq.read_table(lerobot / info["data_path"].format(chunk_index=0, file_index=0))
    assert set(table.column_names) == set(info["features"])
    assert table["index"].to_pylist() == list(range(16)) and table["episode_index"].to_pylist() == [0] * 7 + [1] * 9
    with h5py.File(folder / "episode_000001.h5") as file:
        for name in ("colour", "depth"):
            assert table[f"observation.images.{name}"][9]["bytes"].as_py() == bytes(file[f"pictures/{name}"][2])
        assert np.allclose(np.array(table["observation.K"].to_pylist())[8], file["K"])
        tumour = np.array(table["observation.tumour_predicted"].to_pylist())
        assert np.allclose(tumour[7:], file["tumour_predicted"], atol=1e-7)
        actions = np.array(table["action"].to_pylist())[7:]
        assert np.allclose(poses_after(file["T_world_tool"][0], actions), file["T_world_tool"], atol=1e-6)
    episodes = pq.read_table(lerobot / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(row["dataset_from_index"], row["dataset_to_index"]) for row in episodes] == [(0, 7), (7, 16)]
    assert [row["tasks"] for row in episodes] == [[TASKS["press"]], [TASKS["slide"]]]
    tasks = pq.read_table(lerobot / "meta/tasks.parquet").to_pandas()
    assert list(tasks.index) == [TASKS["press"], TASKS["slide"]] and list(tasks["task_index"]) == [0, 1]
    stats = json.loads((lerobot / "meta/stats.json").read_text())
    assert set(stats) == set(info["features"]) and np.shape(stats["observation.images.colour"]["mean"]) == (3, 1, 1)


@pytest.mark.skipif(FOREIGN is None, reason="needs SULCUS_FORMATS_PYTHON, a Python with lerobot")
def test_lerobot_reader_matches_read_episodes(lerobot, folder, tmp_path):
    out = tmp_path / "read.npz"
    words = [str(FOREIGN), "-c", READ, str(lerobot), str(tmp_path / "cache"), str(out)]
    done = subprocess.run(words, capture_output=True, text=True, env={**os.environ, "HF_HUB_OFFLINE": "1"}, check=False)
    assert done.returncode == 0, done.stderr
    ours = read_episodes(folder, ["colour", "depth", "tumour_predicted"]).get_window(1, 2)
    with np.load(out) as read:
        assert read["count"] == 16 and read["task"] == TASKS["slide"] and read["action"].shape == (2, 6)
        assert np.allclose(read["depth"] * 1e-5, ours["depth"][0], atol=1e-8)
        assert np.abs(255.0 * read["colour"].transpose(1, 2, 0) - ours["colour"][0]).max() < 2.0
        assert np.array_equal(read["picture"].shape, (HEIGHT, WIDTH, 3))
        assert np.allclose(read["tumour"], ours["tumour_predicted"][0], atol=1e-7)


def test_missing_pyarrow_message_names_the_extra(folder, tmp_path):
    code = (
        "import sys; sys.modules['pyarrow'] = None\nfrom scenes.cli import main\n"
        "sys.exit(main(['convert', sys.argv[1], '--to', 'lerobot', '--out', sys.argv[2]]))"
    )
    words = [sys.executable, "-c", code, str(folder), str(tmp_path / "x")]
    done = subprocess.run(words, capture_output=True, text=True, cwd=Path(__file__).parents[1], check=False)
    assert done.returncode == 2 and ".[data]" in done.stderr


def test_combined_row_statistics_equal_statistics_of_all_rows():
    rows = np.random.default_rng(0).normal(size=(20, 3))
    rows[3, 1] = np.nan
    said = (RowStatistics.compute(rows[:7]) + RowStatistics.compute(rows[7:])).to_lists()
    for name, of in (("min", np.nanmin), ("max", np.nanmax), ("mean", np.nanmean), ("std", np.nanstd)):
        assert np.allclose(said[name], of(rows, axis=0))
    assert said["count"] == [20] and RowStatistics.compute(np.full((2, 1), np.nan)).to_lists()["mean"] == [0.0]
