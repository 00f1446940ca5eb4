"""Comparison of tissue laws with measured curves."""

import json

import numpy as np
import pytest

from scenes.cli import main
from scenes.report.tissue import COLUMNS, compare_tissue, fit_law, read_measured_tissues
from sim.errors import InputError
from sim.material import Material

HEAD = ",".join(name for pair in COLUMNS.values() for name in pair)


def write_curves(path, mu=1300.0, alpha=-17.0, noise=0.0):
    """Closed forms of an incompressible Ogden law, with relative noise, as a file of measured stresses."""
    random = np.random.default_rng(0)
    strain = np.linspace(0.0, 1.0, 17)
    sides = [1.0 + 0.1 * strain, 1.0 - 0.1 * strain]
    uniaxial = [2.0 * mu / alpha * (side ** (alpha - 1.0) - side ** (-alpha / 2.0 - 1.0)) for side in sides]
    shear = 0.2 * strain
    large = shear / 2.0 + np.sqrt(1.0 + shear**2 / 4.0)
    sheared = 2.0 * mu / alpha * (large**alpha - large**-alpha) / (large + 1.0 / large)
    stresses = [1e-3 * stress * (1.0 + noise * random.normal(size=17)) for stress in (*uniaxial, sheared)]
    columns = [column for pair in zip((*sides, shear), stresses, strict=True) for column in pair]
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=HEAD, comments="", fmt="%.6f")


@pytest.mark.parametrize(("mu", "alpha"), [(1300.0, -17.0), (900.0, 3.0), (2.0, -35.0)])
def test_parameters_of_generated_curves_are_found(tmp_path, mu, alpha):
    write_curves(tmp_path / "brain.csv", mu, alpha)
    (measured,) = read_measured_tissues(tmp_path)
    found = fit_law("ogden", measured)
    assert found.terms[0] == pytest.approx((2.0 * mu, alpha), rel=5e-3)
    assert min(compare_tissue("ogden", found, measured).r2.values()) > 0.9999
    other = compare_tissue("neo-hookean", fit_law("neo-hookean", measured), measured)
    assert other.is_good == (alpha > 0.0)


def test_r2_and_error_equal_their_definitions(tmp_path):
    write_curves(tmp_path / "brain.csv", noise=0.05)
    (measured,) = read_measured_tissues(tmp_path)
    tissue = Material("neo-hookean", 3000.0, 0.4999999)
    fit = compare_tissue("it", tissue, measured)
    stretch, stress = measured.tests["compression"]
    model = 1000.0 * (stretch - stretch**-2.0)
    wanted = 1.0 - ((model - stress) ** 2).sum() / ((stress - stress.mean()) ** 2).sum()
    assert fit.r2["compression"] == pytest.approx(wanted, abs=1e-4)
    assert fit.error["compression"] == pytest.approx(model[-1] / stress[-1] - 1.0, abs=1e-4)


def test_report_command_writes_page_and_plots(tmp_path, capsys):
    write_curves(tmp_path / "one & <two>.csv", noise=0.02)
    words = ["report", "--tissue", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main([*words, "--json"]) == 0
    fits = json.loads(capsys.readouterr().out)["fits"]
    assert {"ogden, fitted", "linear, fitted", "default", "minutes"} <= {fit["model"] for fit in fits}
    page = (tmp_path / "out" / "index.html").read_text()
    assert page.count("<svg") == 1 and "one &amp; &lt;two&gt;" in page and "It says nothing about a patient" in page
    assert (tmp_path / "out" / "one & <two>.png").stat().st_size > 5000
    assert main(words) == 0 and "ogden, fitted" in capsys.readouterr().out


def test_file_may_have_one_test_and_empty_cells(tmp_path):
    rows = [f" {1.0 + 0.01 * k},{0.03 * k},,," for k in range(9)]
    (tmp_path / "brain.csv").write_text("\r\n".join([HEAD, *rows[:4], "1.04,,,,", *rows[4:]]), encoding="utf-8-sig")
    (measured,) = read_measured_tissues(tmp_path)
    assert list(measured.tests) == ["tension"] and measured.tests["tension"][1].tolist()[-1] == pytest.approx(240.0)
    assert main(["report", "--tissue", str(tmp_path), "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "brain.png").stat().st_size > 5000


def test_column_without_its_partner_is_rejected(tmp_path):
    (tmp_path / "brain.csv").write_text(f"{','.join(COLUMNS['shear'])},stretch_tension\n0,0,1\n0.1,1,1.1\n0.2,2,1.2\n")
    with pytest.raises(InputError, match="a column stretch_tension without stress_tension_kPa"):
        read_measured_tissues(tmp_path)


GOOD = "0.95,-0.1\n0.92,-0.2\n"


@pytest.mark.parametrize(
    ("rows", "problem"),
    [
        ("1,0\n0.9,-1\n", "3 or more rows"),
        ("1,0\n0.9,x\n0.8,-1\n", "need numbers: could not convert string to float: 'x'"),
        (f"1,0\n{GOOD}1.2,-0.3\n", "stretch_compression is 0.92 to 1.2, outside its range"),
        (f"1,0\n{GOOD}0.9,-300\n", "stress above 100 kPa"),
        (f"1,0\n{GOOD}0.9,1\n", "wrong sign"),
    ],
)
def test_unreadable_measurements_are_rejected(tmp_path, capsys, rows, problem):
    (tmp_path / "brain.csv").write_text(f"{','.join(COLUMNS['compression'])}\n{rows}")
    words = ["report", "--tissue", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main(words) == 2
    said = capsys.readouterr().err
    assert "brain.csv" in said and problem in said and "negative in compression" in said
    assert not (tmp_path / "out").exists()
    (tmp_path / "brain.csv").write_text(f"{HEAD.replace(',', ';')}\n")
    assert main(words) == 2 and "its columns are stretch_tension;" in capsys.readouterr().err
    assert main([*words[:-1], str(tmp_path / "out"), "--seed-protocol"]) == 2
    assert main(["report", "--tissue", str(tmp_path / "none")]) == 2
