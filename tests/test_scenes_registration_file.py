"""Registration files: round trip, and rejected registrations of another body."""

import json
from dataclasses import replace

import numpy as np
import pytest
from test_ar_registration import SCAN, moved

from ar.tracking.registration import register_points
from scenes.script.shipped_files import get_template_path
from scenes.tracked.registration_file import describe_other_mesh, describe_scan, read_registration, write_registration
from sim.bodies.meshfile import read_anatomy
from sim.errors import InputError


def test_registration_file_round_trips_and_rejects_damage(tmp_path):
    path, rng = tmp_path / "r.json", np.random.default_rng(0)
    found = register_points(SCAN, moved(SCAN) + 1e-3 * rng.normal(size=SCAN.shape))
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


def test_registration_accepts_another_mesh_of_the_same_body(tmp_path):
    anatomy, path = read_anatomy(get_template_path()), tmp_path / "r.json"
    made = describe_scan(anatomy)
    found = replace(register_points(SCAN, moved(SCAN)), scan=made)
    write_registration(path, found)
    again = read_registration(path)
    assert again.scan.digest == made.digest and again.scan.compute_distance(made) < 1e-9
    assert describe_other_mesh(again, anatomy, path) == ""
    assert "does not say of which anatomy" in describe_other_mesh(replace(again, scan=None), anatomy, path)
    meshed = replace(again, scan=replace(made, digest="other", bounds=made.bounds + 2e-3))
    assert "another mesh" in describe_other_mesh(meshed, anatomy, path)
    for other in (replace(made, bounds=made.bounds + 2e-2), replace(made, target=made.target + [0.0, 1e-2, 0.0])):
        with pytest.raises(InputError, match="made for another anatomy: bounds or tumour are"):
            describe_other_mesh(replace(again, scan=replace(other, digest="other")), anatomy, path)
    stored = json.loads(path.read_text())
    path.write_text(json.dumps(stored | {"scanned": stored["scanned"] | {"tumour_mm": [1, 2]}}))
    with pytest.raises(InputError, match="a tumour's middle of 3"):
        read_registration(path)
