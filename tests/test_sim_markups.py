"""Markups of 3D Slicer: points, curves and tables, in the system that they state."""

import numpy as np
import pytest
from test_scenes_markups import RADIUS, curve, fcsv, markup

from sim.bodies.markups import read_markup
from sim.errors import InputError


@pytest.mark.parametrize("system", ["LPS", "RAS", None])
def test_markup_coordinates_use_given_or_default_system(tmp_path, system):
    found = read_markup(markup(tmp_path / "p.mrk.json", [[10.0, 20.0, 30.0], [1.0, 2.0, 3.0]], "Line", system))
    np.testing.assert_allclose(found.points, [[0.01, 0.02, 0.03], [0.001, 0.002, 0.003]])


OLD = '1,{},{},30,0,0,0,1,1,1,0,"F, 1",,'


@pytest.mark.parametrize(("system", "sign"), [("LPS", -1), ("1", -1), ("RAS", 1), ("0", 1)])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_fcsv_points_use_the_given_coordinate_system(tmp_path, system, sign, end):
    """Slicer 5 has a carriage return before the status: 2 is placed, 1 is not."""
    rows = (OLD.format(10 * sign, 20 * sign), OLD.format(sign, 2) + "\r,2,0", OLD.format(5, 6) + "\r,1,0")
    found = read_markup(fcsv(tmp_path / "p.fcsv", system, *rows, end=end))
    np.testing.assert_allclose(found.points, [[0.01, 0.02, 0.03], [0.001, 0.002 * sign, 0.03]])
    assert found.kind == "Fiducial"


@pytest.mark.parametrize(
    ("system", "row", "reason"),
    [
        (None, OLD.format(1, 2), "does not state its coordinate system"),
        ("2", OLD.format(1, 2), "its coordinate system is '2'"),
        ("LPS", OLD.format(1, "nan"), "non-finite coordinates"),
        ("LPS", "1,2", "cannot be read as markups"),
        ("LPS", OLD.format(1, 2).replace('1",', "1,"), "cannot be read as markups"),
        ("LPS", "", "has 0 placed points"),
    ],
)
def test_incomplete_fcsv_files_are_rejected(tmp_path, system, row, reason):
    with pytest.raises(InputError, match=reason):
        read_markup(fcsv(tmp_path / "p.fcsv", system, row))


def test_closed_curve_passes_smoothly_through_its_points(tmp_path):
    smooth = read_markup(markup(tmp_path / "c.mrk.json", curve(), "ClosedCurve")).fit_curve()
    np.testing.assert_allclose(1e3 * np.linalg.norm(smooth, axis=1), RADIUS, atol=0.15)
    np.testing.assert_allclose((1e3 * smooth[:, 1] / 30.0) ** 2 + (1e3 * smooth[:, 0] / 18.0) ** 2, 1.0, atol=0.04)


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ({"system": "IJK"}, "its coordinate system is 'IJK': it must be LPS or RAS"),
        ({"coordinateUnits": ["m", "m", "m"]}, "must be mm"),
        ({"points": [[0.0, np.nan, 0.0]]}, "non-finite coordinates"),
        ({"points": [[0.0, 1e308, 0.0]]}, "more than 10 m away: coordinates are in mm"),
        ({"points": []}, "has 0 placed points"),
        ({"controlPoints": 3}, "cannot be read as markups"),
    ],
)
def test_unsupported_markups_are_rejected(tmp_path, more, reason):
    points = more.pop("points", [[1.0, 2.0, 3.0]])
    with pytest.raises(InputError, match=reason):
        read_markup(markup(tmp_path / "p.mrk.json", points, **more))
