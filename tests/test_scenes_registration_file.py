"""Registration files: what is written is read, and other bodies are refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
from test_ar_registration import SCAN, TRUE, moved

from ar.tracking.registration import registered
from scenes.cli import main
from scenes.script.shipped_files import template_path
from scenes.tracked.registration_file import other_mesh, read_registration, scanned_of, write_registration
from sim.bodies.meshfile import read_anatomy
from sim.errors import InputError


def test_a_file_gives_back_what_was_written_and_damage_is_named(tmp_path):
    path, rng = tmp_path / "r.json", np.random.default_rng(0)
    found = registered(SCAN, moved(SCAN) + 1e-3 * rng.normal(size=SCAN.shape))
    write_registration(path, found)
    again = read_registration(path)
    for name in ("T_patient_scan", "covariance", "centre"):
        np.testing.assert_allclose(getattr(again, name), getattr(found, name), rtol=1e-12, atol=1e-15)
    stored = json.loads(path.read_text())
    mirrored = np.array(stored["T_patient_scan_mm"]) * [1, 1, -1, 1]
    for change, words in (
        ({"T_patient_scan_mm": mirrored.tolist()}, "no rigid motion"),
        ({"covariance": (-np.eye(6)).tolist()}, "no covariance"),
        ({"covariance": (1e300 * np.eye(6)).tolist()}, "no covariance"),
        ({"centre_mm": [0.0, 1e308, 0.0]}, "not within 10 m: numbers are in millimetres"),
        ({"T_patient_scan_mm": (np.eye(4) + np.outer(np.eye(4)[0], [0, 0, 0, 1e308])).tolist()}, "not within 10 m"),
        ({"centre_mm": [0, 0]}, "other shapes"),
        ({"format": "mine"}, "format is not"),
    ):
        path.write_text(json.dumps(stored | change))
        with pytest.raises(InputError, match=words) as caught:
            read_registration(path)
        assert str(caught.value).startswith(str(path))


def test_it_is_refused_for_another_body_and_not_for_another_mesh(tmp_path):
    anatomy, path = read_anatomy(template_path()), tmp_path / "r.json"
    made = scanned_of(anatomy)
    found = replace(registered(SCAN, moved(SCAN)), scanned=made)
    write_registration(path, found)
    again = read_registration(path)
    assert again.scanned.digest == made.digest and again.scanned.apart(made) < 1e-9
    assert other_mesh(again, anatomy, path) == ""
    assert "does not say of which anatomy" in other_mesh(replace(again, scanned=None), anatomy, path)
    meshed = replace(again, scanned=replace(made, digest="other", bounds=made.bounds + 2e-3))
    assert "another mesh" in other_mesh(meshed, anatomy, path)
    for other in (replace(made, bounds=made.bounds + 2e-2), replace(made, target=made.target + [0.0, 1e-2, 0.0])):
        with pytest.raises(InputError, match="made for another anatomy: bounds or tumour are"):
            other_mesh(replace(again, scanned=replace(other, digest="other")), anatomy, path)
    stored = json.loads(path.read_text())
    path.write_text(json.dumps(stored | {"scanned": stored["scanned"] | {"tumour_mm": [1, 2]}}))
    with pytest.raises(InputError, match="a tumour's middle of 3"):
        read_registration(path)


def test_the_command_writes_it_and_tells_the_error_at_the_tumour(tmp_path, capsys):
    pairs, out = tmp_path / "pairs.csv", tmp_path / "r.json"
    rng = np.random.default_rng(0)
    table = 1e3 * np.hstack([SCAN, moved(SCAN) + 5e-4 * rng.normal(size=SCAN.shape)])
    np.savetxt(pairs, table, delimiter=",", header="x,y,z,px,py,pz", comments="")
    assert main(["register", str(pairs), "--out", str(out), "--anatomy", str(template_path()), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert 0.1 < said["tumour_p95_mm"] < 5.0 and said["rms_mm"] < 1.0
    np.testing.assert_allclose(read_registration(out).T_patient_scan, TRUE, atol=5e-3)
    assert read_registration(out).scanned.digest == read_anatomy(template_path()).digest
    assert len(said["residuals_mm"]) == len(said["left_out_mm"]) == 7 and not said["suspect"]
    assert main(["register", str(pairs), "--out", str(out), "--surface", str(pairs)]) == 2
    assert "give it by --anatomy" in capsys.readouterr().err
    table[4, 3] += 5.0
    np.savetxt(pairs, table, delimiter=",", header="x,y,z,px,py,pz", comments="")
    assert main(["register", str(pairs), "--out", str(out), "--force"]) == 0
    assert "pair 5 is suspect: it lies" in capsys.readouterr().out
    np.savetxt(pairs, table[:3], delimiter=",", header="x,y,z,px,py,pz", comments="")
    assert main(["register", str(pairs), "--out", str(out), "--force"]) == 0
    assert "three pairs do not tell a wrong one" in capsys.readouterr().out
