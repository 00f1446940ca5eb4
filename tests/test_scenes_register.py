"""Command that registers a patient: its file, and the error at the tumour."""

import json

import numpy as np
from test_ar_registration import SCAN, TRUE, moved

from scenes.cli import main
from scenes.script.shipped_files import get_template_path
from scenes.tracked.registration_file import read_registration
from sim.bodies.meshfile import read_anatomy


def test_register_command_writes_file_and_error_at_tumour(tmp_path, capsys):
    pairs, out = tmp_path / "pairs.csv", tmp_path / "r.json"
    rng = np.random.default_rng(0)
    table = 1e3 * np.hstack([SCAN, moved(SCAN) + 5e-4 * rng.normal(size=SCAN.shape)])
    np.savetxt(pairs, table, delimiter=",", header="x,y,z,px,py,pz", comments="")
    assert main(["register", str(pairs), "--out", str(out), "--anatomy", str(get_template_path()), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert 0.1 < said["tumour_p95_mm"] < 5.0 and said["rms_mm"] < 1.0
    np.testing.assert_allclose(read_registration(out).T_patient_scan, TRUE, atol=5e-3)
    assert read_registration(out).scan.digest == read_anatomy(get_template_path()).digest
    assert len(said["residuals_mm"]) == len(said["left_out_mm"]) == 7 and not said["suspect"]
    assert main(["register", str(pairs), "--out", str(out), "--surface", str(pairs)]) == 2
    assert "give it by --anatomy" in capsys.readouterr().err
    table[4, 3] += 5.0
    np.savetxt(pairs, table, delimiter=",", header="x,y,z,px,py,pz", comments="")
    assert main(["register", str(pairs), "--out", str(out), "--force"]) == 0
    assert "pair 5 may be an outlier: it is" in capsys.readouterr().out
    np.savetxt(pairs, table[:3], delimiter=",", header="x,y,z,px,py,pz", comments="")
    assert main(["register", str(pairs), "--out", str(out), "--force"]) == 0
    assert "three pairs cannot show an outlier" in capsys.readouterr().out
