"""Episodes as folders of images and tables."""

import csv
import json

import h5py
import numpy as np

from scenes.cli import main


def test_folder_export_has_images_and_tables(folder, tmp_path):
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
