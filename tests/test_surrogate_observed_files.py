"""Observation files written by other programs."""

import numpy as np
from test_scenes_markups import markup

from sim.bodies.markups import read_markup
from surrogate.locating.observed_files import read_observation


def test_files_with_byte_order_mark_are_read(tmp_path):
    """Windows editors write UTF-8 with a byte order mark; a table may have point labels."""
    path = markup(tmp_path / "p.mrk.json", [[10.0, 20.0, 30.0]])
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    table = tmp_path / "p.csv"
    table.write_bytes(b"\xef\xbb\xbflabel,x,y,z\nF-1,10,20,30\n")
    for points in (read_markup(path).points, read_observation(table).now):
        np.testing.assert_allclose(points, [[0.01, 0.02, 0.03]])
