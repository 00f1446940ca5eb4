"""`sulcus fit`: the command, its file in an ensemble, and its benchmark on known tissue."""

import json

import numpy as np
import pytest
from locators import dent, locator_of

from benchmarks.studies.fit_study import summarise_fits
from benchmarks.studies.fit_twins import build_loads, sample_patient, sample_positions
from scenes.cli import main
from scenes.commands.fit import find_fitted_tissue, format_fit
from sim.bodies.meshfile import write_anatomy
from sim.errors import InputError
from sim.loads import Pushed
from surrogate.fitting import fit
from surrogate.fitting.responses import SOLVED_SKULLS, Responses
from surrogate.fitting.tissue import FittedTissue, load_tissue, save_tissue
from surrogate.locating.locator import find_observed_nodes
from surrogate.locating.locator_store import save_locator


@pytest.fixture(scope="module")
def folder(body, tmp_path_factory):
    """An anatomy with its locator, and two frames."""
    folder = tmp_path_factory.mktemp("fit")
    write_anatomy(folder / "box.vtu", body)
    save_locator(folder / "box.locator.npz", locator_of(body))
    nodes = body.mesh.nodes[np.unique(body.open_surface)]
    for number in (1, 2):
        motion = dent(body, np.random.default_rng(number))[np.unique(body.open_surface)]
        rows = [",".join(f"{value:.5f}" for value in each) for each in 1e3 * np.hstack([nodes, motion])]
        (folder / f"{number}.csv").write_text("\n".join(["x,y,z,dx,dy,dz", *rows]))
    return folder


def by_formula(body, loads, *_):
    """Responses that take no time: dents, other ones in each tissue."""
    random, nodes = np.random.default_rng(0), find_observed_nodes(body)
    count = len(loads.causes[0].point)
    motion = {
        name: np.array([[[dent(body, random)[nodes] for _ in range(count)] for _ in range(4)] for _ in range(3)])
        for name in SOLVED_SKULLS
    }
    return Responses(nodes, motion)


def test_fit_command_writes_the_reported_tissue(body, folder, monkeypatch, capsys):
    monkeypatch.setattr(fit, "solve_responses", by_formula)
    words = ["fit", str(folder / "box.vtu"), str(folder / "1.csv"), str(folder / "2.csv")]
    (folder / "box.fit.parts").mkdir()
    assert main([*words, "--json"]) == 0
    assert not (folder / "box.fit.parts").exists()  # what it kept in case it is stopped
    said = json.loads(capsys.readouterr().out)
    tissue = load_tissue(folder / "box.tissue.json", body.digest)
    assert said["frames"] == tissue.frames == 2 and said["ratio"]["median"] == pytest.approx(tissue.ratio[1])
    assert sum(said["skull"].values()) == pytest.approx(1.0) and said["young_pa"] is None
    assert "Young's modulus" in said["not_known"] and said["outliers"] == [[], []]
    rows = (folder / "2.csv").read_text().splitlines()
    rows[4] = ",".join([*rows[4].split(",")[:3], "9,9,-15"])
    (folder / "3.csv").write_text("\n".join(rows))
    assert main([*words, "--json"]) == 2 and "box.tissue.json: exists" in capsys.readouterr().err
    assert main([*words[:-1], str(folder / "3.csv"), "--json", "--force"]) == 0
    assert json.loads(capsys.readouterr().out)["outliers"] == [[], [3]]
    assert main([*words[:-1], str(folder / "3.csv"), "--force"]) == 0
    said = capsys.readouterr().out
    assert "Frame 2: Left out, off the open cortex or without support by other points: rows 5 of the file." in said
    assert "times as stiff as the brain" in said


def test_fit_command_rejects_bad_input_with_a_message(folder, capsys):
    body, first = str(folder / "box.vtu"), str(folder / "1.csv")
    (folder / "tools.csv").write_text("frame,x,y,z\n2,1,2,3\n")
    assert main(["fit", body, first, first, "--force"]) == 2
    assert "frames 1 and 2 are the same" in capsys.readouterr().err
    assert main(["fit", body, first, "--tool-log", str(folder / "tools.csv"), "--force"]) == 2
    assert "is of frame 2, but there are 1" in capsys.readouterr().err
    assert main(["fit", body, first, "--region", "tumour:9000", "--force"]) == 2
    assert "--region tumour: its stiffness is what `sulcus fit` finds" in capsys.readouterr().err


def test_fitted_tissue_is_found_next_to_its_anatomy(tmp_path):
    share = np.full((3, 13, 33), 1.0 / (3 * 13 * 33))
    save_tissue(tmp_path / "a.tissue.json", FittedTissue("digest", 5, share, np.zeros(0)))
    found = find_fitted_tissue(None, tmp_path / "a.vtu", "digest")
    assert found is not None and found.frames == 5
    assert set(found.not_known) == {"the tumour's stiffness", "the skull", "Poisson's ratio", "Young's modulus"}
    assert sum("about as unknown as before" in line for line in format_fit(found, tmp_path)) == 4
    assert find_fitted_tissue(None, tmp_path / "b.vtu", "digest") is None
    with pytest.raises(InputError, match="no such file"):
        find_fitted_tissue(tmp_path / "c.json", tmp_path / "a.vtu", "digest")


def test_benchmark_row_counts_correct_estimates(body):
    tools = sample_positions(body)
    one = sample_patient(tools, 0, 0, 2, 3)
    assert one == sample_patient(tools, 0, 0, 2, 3) != sample_patient(tools, 0, 1, 2, 3)
    loads = build_loads(body, tools, one)
    pushed = loads.get(Pushed)
    assert pushed is not None and (np.linalg.norm(pushed.force, axis=1) > 0.0).tolist() == [
        True,
        True,
        False,
        False,
        False,
    ]
    sure = np.zeros((3, 13, 33))
    held = one.skull == "bonded"
    sure[0 if held else 1, 0 if one.poisson < 0.4725 else 12, :] = 1.0 / 33.0
    right = summarise_fits(1, [(one, FittedTissue("", 5, sure, np.array([1.0, 2.0])))])
    assert right.sliding == right.poisson == right.held == 100.0 and right.young_within == 0.0 and right.forces == 1
    other = sure[[1, 0, 2]][:, ::-1]
    wrong = summarise_fits(1, [(one, FittedTissue("", 5, other, np.zeros(0)))])
    assert wrong.poisson == wrong.sliding == 0.0 and wrong.young is None
