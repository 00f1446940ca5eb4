"""Craniotomies from `.mrk.json` files of 3D Slicer: points, trajectories and outlines."""

import json

import numpy as np
import pytest
from balls import ball

from scenes.cli import main
from scenes.options.placement_options import point_or_file
from sim.bodies.meshfile import read_anatomy
from sim.bodies.placement import find_within_outline

RADIUS = 55.0  # [mm] of the brain of `ball`, round the origin


def markup(path, points, kind="Fiducial", system="LPS", **more):
    """A file as Slicer writes it, of points [mm, RAS]."""
    signs = {"LPS": [-1.0, -1.0, 1.0], "RAS": [1.0, 1.0, 1.0], None: [-1.0, -1.0, 1.0]}.get(system, [1.0, 1.0, 1.0])
    controls = [
        {"id": str(n), "label": f"F-{n}", "position": (np.array(p) * signs).tolist(), "positionStatus": "defined"}
        for n, p in enumerate(points, start=1)
    ]
    stated = {"type": kind, "coordinateSystem": system, "coordinateUnits": "mm", "controlPoints": controls, **more}
    one = {key: value for key, value in stated.items() if value is not None}
    path.write_text(json.dumps({"@schema": "https://.../markups-schema-v1.0.3.json#", "markups": [one]}))
    return path


def curve(count=9, wide=30.0, high=18.0, over=(0.0, 0.0, 1.0)):
    """Points [mm] of an ellipse on the ball, `wide` and `high` its half axes, seen from `over`."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    across = np.stack([wide * np.cos(angle), high * np.sin(angle)], axis=1)
    up = np.sqrt(RADIUS**2 - (across**2).sum(axis=1))
    axes = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], over])
    return np.column_stack([across, up]) @ axes


def fcsv(path, system, *rows, end="\n"):
    """A file of 3D Slicer's older fiducials; a system of None is not stated."""
    stated = "" if system is None else f"# CoordinateSystem = {system}{end}"
    columns = "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"
    lines = "".join(row + end for row in (columns, *rows))
    path.write_bytes(f"# Markups fiducial file version = 4.11{end}{stated}{lines}".encode())
    return path


def test_points_within_outline_are_on_its_side_of_the_head():
    square = np.array([[-1.0, -1.0, 2.0], [1.0, -1.0, 2.1], [1.0, 1.0, 2.0], [-1.0, 1.0, 2.1]])
    points = np.array([[0.0, 0.0, 2.0], [0.9, -0.9, 2.5], [1.1, 0.0, 2.0], [0.0, -1.2, 2.0], [0.0, 0.0, -2.0]])
    assert find_within_outline(points, square).tolist() == [True, True, False, False, False]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("markups")
    ball(folder)
    return folder


class TestOpenings:
    def found(self, folder, capsys, option, *given):
        file = markup(folder / "given.mrk.json", *given)
        words = ["patient", str(folder / "labels.nii.gz"), "--brain", "1", "--tumour", "2", option, str(file)]
        code = main([*words, "--out", str(folder / "p.vtu"), "--inspect", "--json"])
        said = capsys.readouterr()
        return np.array(json.loads(said.out)["opening"]["at_mm"]) if code == 0 else said.err

    def test_opening_lies_at_point_or_entry_of_trajectory(self, folder, capsys):
        top = [0.0, 0.0, RADIUS]
        old = fcsv(folder / "given.fcsv", "RAS", "1,0,0,60,0,0,0,1,1,1,0,F-1,,")
        assert point_or_file(str(old)) == old
        np.testing.assert_allclose(self.found(folder, capsys, "--opening-at", [[0.0, 0.0, 60.0]]), top, atol=2.5)
        # From far outside and off the middle: neither end is where it enters, whichever is drawn first.
        entry = np.sqrt(RADIUS**2 - 24.0**2)
        for ends in ([[24.0, 0.0, 95.0], [24.0, 0.0, 5.0]], [[24.0, 0.0, 5.0], [24.0, 0.0, 95.0]]):
            found = self.found(folder, capsys, "--opening-at", ends, "Line")
            np.testing.assert_allclose(found, [24.0, 0.0, entry], atol=2.5)
        # Over its deeper end, the tumour's middle.
        over = self.found(folder, capsys, "--opening-over", [[0.0, 30.0, 70.0], [0.0, 25.0, 25.0]], "Line")
        np.testing.assert_allclose(over, RADIUS / np.sqrt(2.0) * np.array([0.0, 1.0, 1.0]), atol=3.5)

    def test_opening_rejects_distant_or_unsupported_markups(self, folder, capsys):
        for option, points, kind, reason in (
            ("--opening-at", [[0.0, 0.0, 90.0]], "Fiducial", "from the nearest cortex"),
            ("--opening-at", [[0.0, 0.0, 55.0]] * 2, "Fiducial", "holds a list of 2 points; --opening-at takes one"),
            ("--opening-at", curve(), "Curve", "holds an open curve; --opening-at takes one point or"),
            ("--opening-at", [[0.0, 0.0, 55.0]], "Plane", "holds a plane; --opening-at takes"),
            ("--opening-over", curve(), "ClosedCurve", "--opening-over takes one point or a line of two points"),
            ("--opening-at", curve()[:2], "ClosedCurve", "needs at least three distinct points"),
            ("--opening-at", curve() + [0.0, 0.0, 30.0], "ClosedCurve", "opening's outline lies up to 2"),
        ):
            assert reason in self.found(folder, capsys, option, points, kind)

    def test_opening_of_the_mesh_follows_the_outline(self, folder, capsys):
        """Ellipse with axes 2 : 1: open nodes lie within it, and nodes well within are open."""
        file = markup(folder / "outline.mrk.json", curve(), "ClosedCurve")
        words = f"anatomy --labels {folder / 'labels.nii.gz'} --brain 1 --tumour 2 --nodes 2500".split()
        assert main([*words, "--opening-at", str(file), "--out", str(folder / "a.vtu"), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["opening"]["over"] == f"what {file} marks"
        anatomy = read_anatomy(folder / "a.vtu")
        outer = np.zeros(len(anatomy.mesh.nodes), bool)
        outer[anatomy.mesh.surface] = True
        x, y, z = 1e3 * anatomy.mesh.nodes.T
        size = np.hypot(x / 18.0, y / 30.0)
        assert size[anatomy.craniotomy].max() < 1.03 and z[anatomy.craniotomy].min() > 0.0
        assert anatomy.craniotomy[outer & (size < 0.97) & (z > 0.0)].all() and anatomy.craniotomy.sum() > 20
