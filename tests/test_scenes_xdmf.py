"""XDMF files of `sulcus convert`, read by ParaView: surfaces, times and values."""

import os
import subprocess
from xml.etree import ElementTree

import h5py
import numpy as np
import pytest
from tiny_episodes import Wanted, write_episode

from scenes.cli import main

PVPYTHON = os.environ.get("SULCUS_PVPYTHON")
"""ParaView's own Python."""
READ = """
import sys
import numpy as np
from paraview import servermanager, simple
from vtkmodules.util.numpy_support import vtk_to_numpy

def copied(array):
    return vtk_to_numpy(array).copy()  # a reader uses its memory again

reader = getattr(simple, sys.argv[1])(**{sys.argv[2]: [sys.argv[3]]})
reader.UpdatePipeline()
times, found = np.array(reader.TimestepValues), {}
for frame, time in enumerate(times):
    reader.UpdatePipeline(time)
    all_of_it = servermanager.Fetch(reader)
    several = all_of_it.IsA("vtkMultiBlockDataSet")
    blocks = [all_of_it.GetBlock(number) for number in range(all_of_it.GetNumberOfBlocks())] if several else [all_of_it]
    for number, block in enumerate(blocks):
        found[f"{number}/{frame}/positions"] = copied(block.GetPoints().GetData())
        found[f"{number}/{frame}/cells"] = copied(block.GetCells().GetConnectivityArray())
        data = block.GetPointData()
        for place in range(data.GetNumberOfArrays()):
            found[f"{number}/{frame}/{data.GetArrayName(place)}"] = copied(data.GetArray(place))
np.savez(sys.argv[4], times=times, **found)
"""


@pytest.fixture(scope="module")
def converted(box, tmp_path_factory):
    """Two episodes of nine frames: of one every third was solved; the other's anatomy is not known."""
    folder = tmp_path_factory.mktemp("set")
    write_episode(folder / "in/known.h5", box, Wanted(9, every=3))
    write_episode(folder / "other/bare.h5", box, Wanted(9, every=3))
    (folder / "other/bodies/0000/anatomy.vtu").unlink()
    given = [str(folder / name) for name in ("in/known.h5", "other/bare.h5")]
    assert main(["convert", *given, "--to", "xdmf", "--out", str(folder / "out")]) == 0
    return folder


@pytest.mark.skipif(PVPYTHON is None, reason="needs SULCUS_PVPYTHON, ParaView's pvpython")
@pytest.mark.parametrize(("reader", "given"), [("XDMFReader", "FileNames"), ("Xdmf3ReaderS", "FileName")])
@pytest.mark.parametrize("name", ["in/known", "other/bare"])
def test_paraview_reads_the_values_of_the_episodes(reader, given, name, converted, tmp_path):
    script, out = tmp_path / "read.py", tmp_path / "read.npz"
    script.write_text(READ)
    path = (converted / "out" / name.split("/")[1]).with_suffix(".xdmf")
    done = subprocess.run(
        [str(PVPYTHON), str(script), reader, given, str(path), str(out)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0 and "ERR" not in done.stderr, done.stderr
    with np.load(out) as read, h5py.File(converted / f"{name}.h5") as file:
        assert np.allclose(read["times"], file["time"])
        tumour, rest = file["tumour_predicted"][:], file["tumour_rest"][:]
        for frame in range(9):
            assert np.allclose(read[f"0/{frame}/positions"], tumour[frame], atol=1e-7)
            assert np.allclose(read[f"0/{frame}/displacement [m]"], tumour[frame] - rest, atol=1e-7)
            cells = read[f"0/{frame}/cells"]
            assert len(cells) == len(rest) if name == "other/bare" else len(cells) % 3 == 0 and cells.max() < len(rest)
            off = read.get(f"0/{frame}/from_finite_elements [m]")
            assert (off is not None) == (frame % 3 == 0) and (off is None or np.allclose(off, 1e-4, atol=1e-7))


def test_xdmf_references_existing_data(folder, tmp_path):
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
