"""Episodes in the formats of others: what is written is what was read."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation
from tiny_episodes import HEIGHT, WIDTH, Wanted, write_episode

from scenes import read_episodes, write_card
from scenes.cli import main
from scenes.episodes.exports.card import keep_card
from scenes.episodes.exports.columns import rate_of, states, twists
from scenes.episodes.exports.tasks import TASKS, held_out
from scenes.episodes.reading.contents import read_contents
from scenes.episodes.run_folder import finished
from sim.errors import InputError
from sim.runtime.atomic_files import written_folder
from sim.runtime.partial_files import partial_path

FOREIGN = os.environ.get("SULCUS_FORMATS_PYTHON")
"""A Python that has lerobot, datasets and mlcroissant, whose own readers then read what is written here."""


@pytest.fixture(scope="module")
def folder(box, tmp_path_factory):
    """Episodes of 7 and 9 frames; of the second every third frame was solved."""
    folder = tmp_path_factory.mktemp("set")
    write_episode(folder / "episode_000000.h5", box, Wanted(7))
    write_episode(folder / "episode_000001.h5", box, Wanted(9, every=3, seed=1, family="slide"))
    return folder


@pytest.fixture(scope="module")
def lerobot(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("lerobot") / "set"
    assert main(["convert", str(folder), "--to", "lerobot", "--out", str(out)]) == 0
    return out


def poses_after(first, steps):
    """Poses (T, 4, 4) from the first (4, 4) on, by twists (T, 6)."""
    found = [np.asarray(first, np.float64)]
    for step in np.asarray(steps, np.float64)[:-1]:
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ found[-1][:3, :3]
        pose[:3, 3] = found[-1][:3, 3] + step[:3]
        found.append(pose)
    return np.stack(found)


def test_twists_lead_from_pose_to_pose(folder):
    tool = read_episodes(folder, ["T_world_tool"], window=9).at(1, 0)["T_world_tool"]
    steps = twists(tool)
    assert np.allclose(poses_after(tool[0], steps), tool, atol=1e-6) and not steps[-1].any() and steps[:-1].any()
    state = states(tool)
    assert np.allclose(state[:, :3], tool[:, :3, 3]) and np.allclose(np.linalg.norm(state[:, 3:], axis=1), 1.0)
    turning = np.tile(np.eye(4), (9, 1, 1))
    for number, angle in enumerate(np.linspace(0.0, 4 * np.pi, 9)):
        turning[number, :2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    around = states(turning)[:, 3:]
    assert (np.einsum("ij,ij->i", around[1:], around[:-1]) > -1e-6).all()


@pytest.mark.parametrize("off", [2e-3, 2e-4, 5e-5])
def test_rate_of_frames_is_that_of_even_steps_to_100_us(off, tmp_path):
    contents, time = SimpleNamespace(path=tmp_path / "e.h5"), 0.04 * np.arange(26)
    time[10] += off
    if off < 1e-4:
        assert rate_of(contents, time) == 25.0
        return
    with pytest.raises(InputError, match="not evenly spaced"):
        rate_of(contents, time)


def test_lerobot_has_its_layout_and_the_pictures_own_bytes(lerobot, folder):
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


@pytest.mark.skipif(FOREIGN is None, reason="needs SULCUS_FORMATS_PYTHON, a Python with lerobot")
def test_lerobots_own_reader_reads_what_ours_reads(lerobot, folder, tmp_path):
    out = tmp_path / "read.npz"
    words = [str(FOREIGN), "-c", READ, str(lerobot), str(tmp_path / "cache"), str(out)]
    done = subprocess.run(words, capture_output=True, text=True, env={**os.environ, "HF_HUB_OFFLINE": "1"}, check=False)
    assert done.returncode == 0, done.stderr
    ours = read_episodes(folder, ["colour", "depth", "tumour_predicted"]).at(1, 2)
    with np.load(out) as read:
        assert read["count"] == 16 and read["task"] == TASKS["slide"] and read["action"].shape == (2, 6)
        assert np.allclose(read["depth"] * 1e-5, ours["depth"][0], atol=1e-8)
        assert np.abs(255.0 * read["colour"].transpose(1, 2, 0) - ours["colour"][0]).max() < 2.0
        assert np.array_equal(read["picture"].shape, (HEIGHT, WIDTH, 3))
        assert np.allclose(read["tumour"], ours["tumour_predicted"][0], atol=1e-7)


def test_robomimic_has_demonstrations_and_holds_one_out(folder, tmp_path, capsys):
    out = tmp_path / "set.hdf5"
    words = ["convert", str(folder), "--to", "robomimic", "--out", str(out), "--json"]
    assert main(words) == 0 and main(words) == 2 and main([*words, "--force"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["held_out"] == 1
    ours = read_episodes(folder, ["depth", "colour", "T_world_tool"], window=7).at(0, 0)
    with h5py.File(out) as file:
        demo = file["data/demo_0"]
        assert "RAS [m]" in file["data"].attrs["space"]
        assert file["data"].attrs["total"] == 16 and "env_name" in json.loads(file["data"].attrs["env_args"])
        assert list(file["mask/train"]) == [b"demo_0"] and list(file["mask/valid"]) == [b"demo_1"]
        assert demo.attrs["num_samples"] == 7 and demo["dones"][:].tolist() == [0] * 6 + [1]
        assert np.array_equal(demo["obs/colour_image"], ours["colour"])
        assert np.array_equal(demo["obs/depth_image"][..., 0], ours["depth"])
        assert np.allclose(demo["actions"], twists(ours["T_world_tool"]))
        assert {len(demo[name]) for name in ("states", "rewards", "obs/tip", "obs/tumour_predicted")} == {7}
    out.write_text("mine")
    assert main(words) == 2 and out.read_text() == "mine"


def test_every_tenth_body_is_held_out(folder):
    contents = read_contents(folder / "episode_000000.h5")
    assert held_out([contents]) == [False] and held_out([contents] * 3) == [False, False, True]
    assert [number for number, out in enumerate(held_out([contents] * 25)) if out] == [9, 19]


def test_a_folder_has_pictures_and_tables(folder, tmp_path):
    assert main(["convert", str(folder), "--to", "folder", "--out", str(tmp_path / "plain")]) == 0
    one = tmp_path / "plain/episode_000001"
    with h5py.File(folder / "episode_000001.h5") as file:
        assert (one / "colour/000004.jpg").read_bytes() == bytes(file["pictures/colour"][4])
        assert (one / "depth/000004.png").read_bytes() == bytes(file["pictures/depth"][4])
        rows = list(csv.DictReader((one / "frames.csv").read_text().splitlines()))
        assert len(rows) == 9 and float(rows[4]["tip_2"]) == file["tip"][4, 2] and rows[8]["distance"] == ""
        fem = list(csv.DictReader((one / "tumour_fem.csv").read_text().splitlines()))
        assert float(fem[3]["1_y"]) == file["tumour_fem"][1, 1, 1] and fem[4]["1_y"] == ""
    said = json.loads((one / "episode.json").read_text())
    assert said["attributes"]["family"] == "slide" and said["arrays"]["tip"]["unit"] == "m"
    assert np.shape(said["arrays"]["K"]["values"]) == (3, 3)


def test_xdmf_refers_to_numbers_that_are_there(folder, tmp_path):
    out = tmp_path / "paraview"
    assert main(["convert", str(folder), "--to", "xdmf", "--out", str(out)]) == 0
    tree = ElementTree.parse(out / "episode_000001.xdmf")
    assert "RAS [m]" in tree.find("Domain/Information[@Name='space']").get("Value")
    grids = tree.findall(".//Grid[@GridType='Uniform']")
    assert len(grids) == 9 and float(grids[3].find("Time").get("Value")) == pytest.approx(0.1)
    assert len(grids[3].findall("Attribute")) == 2 and len(grids[4].findall("Attribute")) == 1  # solved, and not
    for item in (found for grid in grids for found in grid.iter("DataItem")):
        name, place = item.text.split(":")
        with h5py.File(out / name) as file:
            assert " ".join(map(str, file[place].shape)) == item.get("Dimensions")
            if place.endswith("cells"):
                assert file[place].shape[1] == 3 and file[place][:].max() < len(file["tumour/positions/000000"])


def test_a_card_says_what_there_is(folder, tmp_path, capsys):
    (folder / "failed").mkdir(exist_ok=True)
    (folder / "failed/episode_000002.json").write_text("{}")
    run = {
        "format": "sulcus run 1",
        "plan": "tiny",
        "digest": "0",
        "seed": 1,
        "device": "cpu",
        "versions": {"h5py": "3"},
    }
    (folder / "run.json").write_text(json.dumps(run))
    assert main(["convert", str(folder), "--to", "card"]) == 0
    assert "card of 2 episodes written to" in capsys.readouterr().out
    rows = list(csv.DictReader((folder / "episodes.csv").read_text().splitlines()))
    assert [row["frames"] for row in rows] == ["7", "9"] and rows[1]["solved"] == "3"
    assert float(rows[0]["largest_error_mm"]) == pytest.approx(0.1)
    sheet = (folder / "DATASHEET.md").read_text()
    for words in (
        "| slide | 1 | 9 | 3 |",
        "| `force_n` | 0.1 | 1.1 | 2 |",
        "| `site.path` | straight | 2 |",
        "- seed: 0 (in 1)\n- seed: 1 (in 1)",
        "device: cpu; packages: h5py 3",
        "In 2 episodes the files do not say whose brain it is",
        "[press]",
        "0.100 mm",
        "1 could not be made",
    ):
        assert words in sheet
    licence = (folder / "LICENSE.md").read_text()
    assert "CC BY 4.0" in licence and "Louis Collins" not in licence
    described = json.loads((folder / "croissant.json").read_text())
    assert described["conformsTo"][0].endswith("croissant/1.1")
    assert len(write_card(folder)["files"]) == 4  # its own it replaces
    (folder / "LICENSE.md").write_text("mine")
    assert main(["convert", str(folder), "--to", "card"]) == 2 and "--force" in capsys.readouterr().err
    assert (folder / "LICENSE.md").read_text() == "mine"
    assert main(["convert", str(folder), "--to", "card", "--force"]) == 0


def test_a_card_says_whose_brain_it_is_and_what_played(box, tmp_path):
    path = write_episode(tmp_path / "in/episode_000000.h5", box)
    drawn = {"bodies.anatomies": "template", "bodies.tumour.radius_mm": 12.0, "force_n": 0.2}
    with h5py.File(path, "a") as file:
        file.attrs.update({"parameters": json.dumps(drawn), "deformer": "fem"})
    write_card(path.parent)
    sheet = (path.parent / "DATASHEET.md").read_text()
    assert "the brain is the ICBM 152 template's" in sheet and "Finite elements played 1 of the episodes" in sheet
    assert "error of the model" not in sheet and "radius_mm" not in sheet and "from least to greatest" not in sheet
    assert "McGill" in (path.parent / "LICENSE.md").read_text()
    other = write_episode(tmp_path / "other/episode_000000.h5", box)
    (other.parent / "LICENSE.md").write_text("mine")
    for name, given in (("one", [path]), ("two", [path, other])):
        assert main(["convert", *map(str, given), "--to", "folder", "--out", str(tmp_path / name)]) == 0
    assert (tmp_path / "one/DATASHEET.md").read_text() == sheet and (tmp_path / "two/DATASHEET_0.md").is_file()
    assert (tmp_path / "two/LICENSE_1.md").read_text() == "mine"


def test_a_card_is_kept_as_episodes_come(box, tmp_path, monkeypatch):
    def kept(changed):
        return keep_card(tmp_path, finished(tmp_path), changed)

    assert kept(True) is None and not list(tmp_path.iterdir())  # no episode is whole
    write_episode(tmp_path / "episode_000000.h5", box)

    def rows():
        return (tmp_path / "episodes.csv").read_text().count("\n") - 1

    assert kept(False) is None and rows() == 1
    made = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir() if path.is_file()}
    with monkeypatch.context() as held:  # the folder was listed once, by who gives the numbers
        for name in ("glob", "iterdir"):
            held.setattr(Path, name, lambda *given: pytest.fail("the folder was listed again"))
        assert keep_card(tmp_path, {0}, False) is None
    assert kept(False) is None and len(made) == 5
    assert made == {name: (tmp_path / name).stat().st_mtime_ns for name in made}
    assert kept(True) is None and made["DATASHEET.md"] < (tmp_path / "DATASHEET.md").stat().st_mtime_ns
    write_episode(tmp_path / "episode_000001.h5", box)
    (tmp_path / ".sulcus-00000000-1-episode_000002.h5").write_text("half")
    assert kept(False) is None and rows() == 2
    written = (tmp_path / "DATASHEET.md").stat().st_mtime_ns
    assert kept(False) is None and (tmp_path / "DATASHEET.md").stat().st_mtime_ns == written
    (tmp_path / "croissant.json").unlink()
    assert kept(False) is None and (tmp_path / "croissant.json").exists()
    (tmp_path / "LICENSE.md").write_text("mine")
    assert "is not of a card" in (kept(True) or "") and (tmp_path / "LICENSE.md").read_text() == "mine"


@pytest.mark.skipif(FOREIGN is None, reason="needs SULCUS_FORMATS_PYTHON, a Python with mlcroissant")
def test_mlcroissant_finds_nothing_wrong_and_reads_the_episodes(folder):
    write_card(folder)
    read = (
        "import sys, mlcroissant; data = mlcroissant.Dataset(sys.argv[1])\n"
        "issues = data.metadata.issues; assert not issues.errors and not issues.warnings, issues.report()\n"
        "print([row['episodes/frames'] for row in data.records('episodes')])"
    )
    words = [str(FOREIGN), "-c", read, str(folder / "croissant.json")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[7, 9]"


@pytest.mark.parametrize("name", ["lerobot", "folder", "xdmf"])
def test_folders_are_not_mixed_with_others(name, folder, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine").write_text("mine")
    words = ["convert", str(folder), "--to", name, "--out", str(out)]
    assert main(words) == 2 and "not empty" in capsys.readouterr().err
    (out / "mine").unlink()
    assert main(words) == 0 and [path.name for path in tmp_path.iterdir()] == ["out"]


def test_what_does_not_go_together_is_a_sentence_and_leaves_nothing(folder, box, tmp_path, capsys):
    wide = write_episode(tmp_path / "in/wide.h5", box, Wanted(4, width=48))
    bare = write_episode(tmp_path / "in/bare.h5", box, Wanted(4))
    with h5py.File(bare, "a") as file:
        del file["T_world_tool"]
    for given, words in (([folder, wide], "convert them apart"), ([bare], "has no tool")):
        for name in ("lerobot", "robomimic"):
            out = tmp_path / ("x.hdf5" if name == "robomimic" else "x")
            assert main(["convert", *map(str, given), "--to", name, "--out", str(out)]) == 2
            assert words in capsys.readouterr().err.splitlines()[-1]
    for given in (["--to", "lerobot"], ["--to", "card", "--out", "x"]):
        assert main(["convert", str(folder), *given]) == 2 and "--out" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in"]


def test_what_is_interrupted_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt), written_folder(tmp_path / "out", 10) as partial:
        (partial / "a").write_text("a")
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


def test_what_a_killed_run_left_is_removed_and_what_runs_is_not(tmp_path):
    out, code = tmp_path / "out", (
        "import os, sys; from pathlib import Path; from sim.runtime.atomic_files import written_folder\n"
        "with written_folder(Path(sys.argv[1]), 10) as partial: (partial / 'a').mkdir(); os.kill(os.getpid(), 9)"
    )  # fmt: skip
    done = subprocess.run([sys.executable, "-c", code, str(out)], cwd=Path(__file__).parents[1], check=False)
    (left,) = tmp_path.iterdir()
    assert done.returncode == -9 and (left / "a").exists()
    with written_folder(out, 10) as partial:
        assert not left.exists()
        with written_folder(tmp_path / "other", 10):
            assert partial.exists()
    assert {path.name for path in tmp_path.iterdir()} == {"out", "other"}


def test_a_folder_that_another_run_is_writing_is_rejected(tmp_path):
    folder = tmp_path / "out"
    other = partial_path(folder).with_name(partial_path(folder).name.replace(str(os.getpid()), str(os.getppid())))
    other.mkdir()
    with pytest.raises(InputError, match="another run is writing it"), written_folder(folder):
        pytest.fail("entered")
    assert list(tmp_path.iterdir()) == [other]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is full")
def test_a_full_disk_is_said_and_nothing_stays(tmp_path):
    with pytest.raises(InputError, match="No space left"), written_folder(tmp_path / "out", 10) as partial:
        (partial / "a").write_text("a")
        with open("/dev/full", "w") as full:
            full.write("x" * 10_000)
    assert not list(tmp_path.iterdir())


def test_without_pyarrow_lerobot_names_what_to_install(folder, tmp_path):
    code = (
        "import sys; sys.modules['pyarrow'] = None\nfrom scenes.cli import main\n"
        "sys.exit(main(['convert', sys.argv[1], '--to', 'lerobot', '--out', sys.argv[2]]))"
    )
    words = [sys.executable, "-c", code, str(folder), str(tmp_path / "x")]
    done = subprocess.run(words, capture_output=True, text=True, cwd=Path(__file__).parents[1], check=False)
    assert done.returncode == 2 and ".[data]" in done.stderr
