"""`sulcus locate`: mesh and figures from point files, and rejected files."""

import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import make_box
from locators import dent, locator_of
from theatres import knowing_nothing

from scenes.cli import main
from sim.bodies.meshfile import read_mesh, write_anatomy
from sim.effects import Elasticity
from sim.errors import InputError
from sim.material import Material
from surrogate.data.solution_rows import describe_tissue_source
from surrogate.locating.causes import KINDS
from surrogate.locating.locator_store import load_locator, save_locator
from surrogate.locating.observation import MAX_POINTS, Observation, choose_point_numbers, to_evidence
from surrogate.locating.regions import Region
from surrogate.model.store import save

TUMOUR = (Region(2, 3.0),)


@pytest.fixture(scope="module")
def body():
    box = make_box(cells=(8, 8, 5), spacing=9e-3, tumour=12e-3, opening=30e-3)
    return replace(box, mesh=replace(box.mesh, nodes=box.mesh.nodes + [0.04, 0.03, 0.02]))


@pytest.fixture(scope="module")
def files(body, tmp_path_factory):
    """An anatomy with a locator by formula, and a truth."""
    folder, random = tmp_path_factory.mktemp("locate"), np.random.default_rng(0)
    write_anatomy(folder / "box.vtu", body)
    save_locator(folder / "box.locator.npz", locator_of(body))
    truth = dent(body, random)
    triangles = body.open_surface[random.integers(len(body.open_surface), size=50)]
    share = random.dirichlet(np.ones(3), 50)
    rest, moved = (np.einsum("nc,nci->ni", share, field[triangles]) for field in (body.mesh.nodes, truth))
    moved = moved + 1e-4 * random.standard_normal((50, 3))
    sigma = np.full((50, 1), 0.15)
    for name, header, table in (
        ("vessels", "x,y,z,dx,dy,dz,sigma", np.hstack([1e3 * rest, 1e3 * moved, sigma])),
        ("plain", "x,y,z,dx,dy,dz", np.hstack([1e3 * rest, 1e3 * moved])),
        ("cloud", "x,y,z,sigma", np.hstack([1e3 * (rest + moved), sigma])),
        ("tips", "x,y,z", 1e3 * (rest + moved)[:3]),
    ):
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header=header, comments="")
    return folder, truth


def test_locate_writes_mesh_and_figures_in_millimetres(files, body, capsys):
    folder, truth = files
    out = folder / "located.vtu"
    words = ["locate", str(folder / "box.vtu"), str(folder / "vessels.csv"), "--out", str(out), "--json"]
    assert main(words) == 0
    said = json.loads(capsys.readouterr().out)
    expected = {"centroid_mm", "covariance_mm2", "p95_mm", "explained", "causes", "bias_mm", "milliseconds", "outliers"}
    assert expected <= set(said) and set(said["causes"]) == set(KINDS) and said["points"] == 50
    assert np.shape(said["covariance_mm2"]) == (3, 3) and np.linalg.eigvalsh(said["covariance_mm2"]).min() > 0.0
    tumour = 1e3 * truth[body.tumour_nodes].mean(axis=0)
    assert np.linalg.norm(np.array(said["centroid_mm"]) - tumour) < 0.5 * np.linalg.norm(tumour) + 0.3
    assert said["explained"] > 0.9
    found = read_mesh(out)
    field = found.point_data["displacement"]
    assert field.shape == truth.shape and np.isfinite(field).all()
    assert found.point_data["covariance"].shape == (len(field), 6)
    trace = found.point_data["covariance"][:, :3].sum(axis=1)
    assert found.point_data["deviation"] == pytest.approx(np.sqrt(np.maximum(trace, 0.0)), abs=1e-9)
    assert main([*words, "--force"]) == 0  # the same again, over its own file
    assert json.loads(capsys.readouterr().out)["centroid_mm"] == said["centroid_mm"]


def test_rigid_option_takes_millimetres_and_rejects_bad_values(files, capsys):
    """Zero gives no rigid error; implausible values are rejected before output is written."""
    folder, _ = files
    out, bias = folder / "rigid.vtu", []
    words = f"locate {folder / 'box.vtu'} {folder / 'plain.csv'} --out {out} --json --force --rigid".split()
    for rigid in ("-1", "nan", "20.5"):
        assert main([*words, rigid]) == 2 and not out.exists()
        assert f"a rigid error of {rigid} mm is none that a tracker has" in capsys.readouterr().err
    for rigid in ("0", "0.8", "20"):
        assert main([*words, rigid]) == 0
        bias.append(np.linalg.norm(json.loads(capsys.readouterr().out)["bias_mm"]))
    assert bias[0] < 1e-4 < bias[1] < bias[2]


def test_locate_rejects_points_in_metres_and_accepts_zero_motion(files, tmp_path, capsys):
    """Motions of exactly zero are accepted."""
    folder, _ = files
    table, path = np.loadtxt(folder / "vessels.csv", delimiter=",", skiprows=1), tmp_path / "seen.csv"
    said_of = ((1.0, 1.0, ""), (1e-3, 1.0, "no point moves"), (1.0, 1e-3, "a sigma is 0.00015 mm"), (0.0, 1.0, ""))
    for times, sigma, refused in said_of:
        seen = table * np.repeat([1.0, times, sigma], [3, 3, 1])
        np.savetxt(path, seen, delimiter=",", header="x,y,z,dx,dy,dz,sigma", comments="")
        assert main(["locate", str(folder / "box.vtu"), str(path)]) == (2 if refused else 0)
        said = capsys.readouterr()
        assert refused in said.err and ("rather than metres" in said.err) is bool(refused)
        assert "-0.0" not in said.out and ("by 0.0, 0.0, 0.0 mm" in said.out) is (times == 0.0)


def test_locate_rejects_mostly_uncertain_points(files, tmp_path, capsys):
    folder, _ = files
    table, path = np.loadtxt(folder / "vessels.csv", delimiter=",", skiprows=1), tmp_path / "unsure.csv"
    for unsure, code in ((len(table) - 1, 2), (len(table) // 5, 0)):
        seen = table.copy()
        seen[:unsure, 6] = 30.0
        np.savetxt(path, seen, delimiter=",", header="x,y,z,dx,dy,dz,sigma", comments="")
        assert main(["locate", str(folder / "box.vtu"), str(path)]) == code
        assert ("have a sigma of 30 mm or more" in capsys.readouterr().err) is (code == 2)


def test_locate_json_has_warnings_and_regions(files, body, tmp_path, capsys):
    """Warnings of outliers, and regions of the locator."""
    folder, _ = files
    path = tmp_path / "own.npz"
    save_locator(path, replace(load_locator(folder / "box.locator.npz", body), regions=TUMOUR))
    table = np.loadtxt(folder / "plain.csv", delimiter=",", skiprows=1)
    table[:, 3:] = [8.0, 0.0, 0.0]
    table[3, 3:] = [0.0, 0.0, 12.0]
    np.savetxt(tmp_path / "slipped.csv", table, delimiter=",", header="x,y,z,dx,dy,dz", comments="")
    words = ["locate", str(folder / "box.vtu"), str(tmp_path / "slipped.csv"), "--locator", str(path)]
    assert main(words) == 0
    sentences = capsys.readouterr().out.splitlines()[5:]
    assert main([*words, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["regions"] == {"tumour": 3.0} and said["warnings"] == sentences and len(sentences) == 3
    assert "error of 8.0 mm" in sentences[0] and "rows 5 of the file" in sentences[2] and said["slipped"]
    assert sentences[1] == "If it was checked, say so by --registration-checked."
    assert main([*words, "--json", "--registration-checked"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert not said["slipped"] and len(said["warnings"]) == 1 and "rows 5 of the file" in said["warnings"][0]


@pytest.mark.parametrize("words", [["plain.csv"], ["cloud.csv"], ["cloud.csv", "--tool", "tips.csv"]])
def test_locate_prints_results_as_text(files, capsys, words):
    folder, _ = files
    words = [str(folder / word) if word.endswith(".csv") else word for word in words]
    assert main(["locate", str(folder / "box.vtu"), *words, "--out", str(folder / "other.vtu"), "--force"]) == 0
    said = capsys.readouterr().out
    assert "The centre of the tumour has moved by" in said and "With a probability of 95 %" in said


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "is empty"),
        ("a,b,c\n1,2,3\n", "give the header x,y,z"),
        ("x,y,z,x\n1,2,3,4\n", "give the header"),
        ("x,y,z\n1,2\n", "row 2 is '1,2', not 3 numbers"),
        ("x,y,z\n1,2,three\n", "row 2 is '1,2,three'"),
        ("x,y,z\n1,2,nan\n", "row 2 has a number that is not finite"),
        ("\nx,y,z\n\n1,2,1e200\n", "row 4 has a number that is not finite, or above 1e+09"),
        ("x,y,z\n\n", "has a header and no rows"),
        ("x,y,z\n1,2,3\n", "1 points say too little"),
        ("x;y;z\n1;2;3\n", "with commas between"),
        ("x,y,z\n" + "40,30,20\n" * 20, "1 places a millimetre apart say too little"),
        ("x,y,z\n" + "".join(f"{31 + k},30,20\n" for k in range(20)), "lie on a line"),
        ("x,y,z," + "d" * 2000 + "\n", "longer ones than a list of points has"),
        ("\x00\x01", "its first line"),
    ],
)
def test_locate_rejects_bad_files_and_writes_nothing(files, tmp_path, capsys, text, reason):
    folder, _ = files
    path = tmp_path / "bad.csv"
    path.write_text(text)
    assert main(["locate", str(folder / "box.vtu"), str(path), "--out", str(tmp_path / "out.vtu")]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert reason in said[-1] and list(tmp_path.iterdir()) == [path]


def seen_dent(body, truth, count):
    """Points (n, 3) [m] all over the open cortex, and their motions by a dent."""
    random = np.random.default_rng(3)
    triangles = body.open_surface[random.integers(len(body.open_surface), size=count)]
    share = random.dirichlet(np.ones(3), count)
    return (np.einsum("nc,nci->ni", share, field[triangles]) for field in (body.mesh.nodes, truth))


@pytest.mark.parametrize("named", [True, False])
def test_locate_uses_a_subset_of_many_points(files, body, named):
    """Unused points do not change the result; outliers are counted in the subset."""
    folder, truth = files
    locator = load_locator(folder / "box.locator.npz", body)
    rest, motion = seen_dent(body, truth, 20_000)
    some, now = (
        choose_point_numbers(len(rest)),
        rest + motion,
    )  # one is off by half a kilometre, and makes no line of them
    assert len(some) == MAX_POINTS and some[0] == 0 and some[-1] == len(rest) - 1
    rest[some[7]] = now[some[7]] = now[some[7]] + [0.0, 0.0, 500.0]
    alone = locator.locate(Observation(now[some], rest[some] if named else None))
    found = locator.locate(Observation(now, rest if named else None))
    assert found.centroid == pytest.approx(alone.centroid) and found.p95 == pytest.approx(alone.p95)
    assert some[7] in found.outliers and found.outliers.tolist() == some[alone.outliers].tolist()


def test_locate_rejects_points_half_off_the_cortex(files, body):
    """No cortex moves by 40 mm: such points are outliers, not a registration error."""
    folder, truth = files
    rest, motion = seen_dent(body, truth, 60)
    now = rest + motion
    now[::2] += [0.0, 0.0, 0.04]
    with pytest.raises(InputError, match="30 of 60 points lie off the open cortex"):
        load_locator(folder / "box.locator.npz", body).locate(Observation(now))


def test_locate_rejects_points_with_contradictory_motions(files, body):
    folder, truth = files
    rest, motion = seen_dent(body, truth, 60)
    twice = Observation(np.concatenate([rest + 3.0 * motion, rest - 3.0 * motion]), np.tile(rest, (2, 1)))
    with pytest.raises(InputError, match="of 120 points fewer than 4 agree"):
        load_locator(folder / "box.locator.npz", body).locate(twice)


def test_empty_or_infinite_observation_is_rejected(body):
    rest = body.mesh.nodes[np.unique(body.open_surface)]
    for now, match in ((np.zeros((0, 3)), "0 points say too little"), (rest * 1e200, "not finite, or beyond")):
        with pytest.raises(InputError, match=match):
            to_evidence(body, Observation(now))


def test_locate_rejects_folder_as_point_file(files, tmp_path, capsys):
    assert main(["locate", str(files[0] / "box.vtu"), str(tmp_path)]) == 2
    assert "is a folder. Give a CSV file with the header x,y,z" in capsys.readouterr().err


def test_locate_rejects_distant_points_before_building_locator(tmp_path, capsys, body):
    """The anatomy has no locator, and none is built."""
    write_anatomy(tmp_path / "box.vtu", body)
    far = tmp_path / "far.csv"
    far.write_text("x,y,z\n" + "".join(f"{300 + 9 * (k % 3)},{9 * (k // 3)},{k % 2}\n" for k in range(9)))
    assert main(["locate", str(tmp_path / "box.vtu"), str(far), "--out", str(tmp_path / "out.vtu")]) == 2
    assert "they are of another brain or frame" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["box.vtu", "far.csv"]


def test_restricted_locator_rejects_mesh_output(files, body, tmp_path, capsys):
    folder, _ = files
    path = tmp_path / "small.npz"
    save_locator(path, load_locator(folder / "box.locator.npz", body).restrict())
    words = ["locate", str(folder / "box.vtu"), str(folder / "vessels.csv"), "--locator", str(path)]
    assert main([*words, "--out", str(tmp_path / "out.vtu")]) == 2
    assert "is small" in capsys.readouterr().err and not (tmp_path / "out.vtu").exists()
    assert main(words) == 0  # for the tumour alone it is enough
    said = capsys.readouterr().out
    assert "The centre of the tumour has moved by" in said and "written" not in said
    assert main([*words, "--json"]) == 0
    alone = json.loads(capsys.readouterr().out)
    whole = [*words[:-1], str(folder / "box.locator.npz"), "--json", "--out", str(tmp_path / "out.vtu")]
    assert main(whole) == 0
    both = json.loads(capsys.readouterr().out)
    assert alone["out"] is None and alone["centroid_mm"] == pytest.approx(both["centroid_mm"], abs=1e-6)


def test_locator_command_writes_file_next_to_anatomy(files, body, tmp_path, capsys, monkeypatch):
    folder, _ = files
    whole, asked = load_locator(folder / "box.locator.npz", body), []

    def make(anatomy, seed, device, causes, folder, progress):
        folder.mkdir()
        asked.append((anatomy.digest, seed, device))
        return replace(whole, regions=causes.regions)

    monkeypatch.setattr("surrogate.locating.locator_store.make_locator", make)
    path = tmp_path / "box.vtu"
    write_anatomy(path, body)
    assert main(["locator", str(path), "--device", "cpu", "--seed", "3"]) == 0
    beside = tmp_path / "box.locator.npz"
    assert asked == [(body.digest, 3, "cpu")] and str(beside) in capsys.readouterr().out
    assert np.array_equal(load_locator(beside, body).prior.shape, whole.prior.shape)
    assert main(["locator", str(path), "--small", "--json", "--force"]) == 0
    said, small = json.loads(capsys.readouterr().out), load_locator(beside, body)
    assert not said["whole"] and np.array_equal(small.prior.nodes, whole.restrict().prior.nodes)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["box.locator.npz", "box.vtu"]
    assert main(["locator", str(path), "--region", "tumour:9000,0.45", "--force"]) == 0
    assert "region 2 (tumour) 3 times as stiff as the brain, Poisson's ratio 0.45" in capsys.readouterr().out
    assert load_locator(beside, body).regions == (Region(2, 3.0, 0.45),)
    assert main(["locator", str(path)]) == 2 and "box.locator.npz: exists. Give --force" in capsys.readouterr().err


def test_locator_of_other_regions_is_rejected(files, body, tmp_path, capsys):
    """Compared are the regions of the locator alone."""
    folder, _ = files
    write_anatomy(tmp_path / "box.vtu", body)
    seen = [str(tmp_path / "box.vtu"), str(folder / "vessels.csv"), "--json"]
    save_locator(tmp_path / "box.locator.npz", replace(load_locator(folder / "box.locator.npz", body), regions=TUMOUR))
    assert main(["locate", *seen]) == main(["locate", *seen, "--region", "tumour:9000"]) == 0
    assert main(["locate", *seen, "--region", "tumour:6000"]) == 2
    assert "knows other regions" in capsys.readouterr().err
    assert main(["locate", *seen, "--region", "oedema:6000"]) == 2
    assert "has no region 3 (oedema)" in capsys.readouterr().err


def test_locator_uses_regions_of_the_trained_models(body, tmp_path, capsys, monkeypatch):
    """Users give the stiffness once, where the models are made."""
    asked = []

    def make(anatomy, seed, device, causes, folder, progress):
        asked.append(causes.regions)
        return locator_of(body)

    monkeypatch.setattr("surrogate.locating.locator_store.make_locator", make)
    path = tmp_path / "box.vtu"
    write_anatomy(path, body)
    learned = Elasticity(Material("neo-hookean", 2000.0, 0.49), {2: Material("neo-hookean", 6000.0, 0.49)})
    save(tmp_path / "box.model.npz", {"linear": knowing_nothing(body, describe_tissue_source(learned))})
    assert main(["locator", str(path), "--device", "cpu"]) == 0 and asked == [TUMOUR]
