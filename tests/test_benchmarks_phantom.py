"""Synthetic checkout of the phantom's data, deformed by FEM, with known motion of the lesion."""

import json

import meshio
import numpy as np
import pytest
from boxes import box, hold
from scipy.spatial.transform import Rotation

from benchmarks.__main__ import main
from benchmarks.studies.phantom_study import BODY, list_files
from sim.effects import Elasticity, Gravity, Held
from sim.fem import Fem
from sim.geometry.locate import locate
from sim.geometry.tetmesh import TetMesh, find_boundary_faces
from sim.loads import build_posture
from sim.material import Material

FLOATS = np.array([[5, -30, 85], [50, 30, 80], [65, -30, 70], [60, 20, 20]]) / 1e3
FRAME = np.array([[0, 0, 0], [5, 0, 0], [0, 10, 0], [0, 0, 15]])  # reference markers o, x, y, z of the holder [mm]
LABELS = [*(f"refframe_{a}" for a in "oxyz"), *(f"float_{k}" for k in range(1, 5)), "lesion_centroid"]


def write_scan(folder, name, floats, lesion, faces, tets=None):
    """Write one scan in coordinates of a scanner that is rotated at random and shifted."""
    reference = FRAME + ([140, 0, 0] if name == "initial" else [0, 0, 120])
    for angles in ([-90, -90, 0], [0, 0, -90]) if name == "initial" else ():  # from the script of the authors
        reference = Rotation.from_euler("xyz", angles, degrees=True).apply(reference)
    turn = Rotation.from_rotvec([1.0, 2.0, ord(name[0])])
    nodes = turn.apply(1e3 * lesion) + [9, 8, 7]
    marked = np.vstack([reference, 1e3 * floats, 1e3 * lesion[np.unique(faces)].mean(axis=0)])
    places = ((turn.apply(marked) + [9, 8, 7]) * [-1, -1, 1]).tolist()
    points = [{"label": f"marker_{label}", "position": at} for label, at in zip(LABELS, places, strict=True)]
    markers, surface = (folder / path for path in list_files(name))
    for path in (markers, surface):
        path.parent.mkdir(parents=True, exist_ok=True)
    markers.write_text(json.dumps({"markups": [{"coordinateSystem": "LPS", "controlPoints": points}]}))
    meshio.write(surface, meshio.Mesh(nodes, [("triangle", faces)]), "gmsh")
    if tets is not None:
        meshio.write(folder / BODY, meshio.Mesh(nodes, [("tetra", tets)]), "gmsh")


@pytest.fixture(scope="module", params=[1.0, 0.7])
def phantom(request, tmp_path_factory):
    """A checkout, its silicone's stiffness relative to the authors', and the lesion's motion from b to c [mm]."""
    folder, mesh = tmp_path_factory.mktemp("phantom"), box((6, 4, 5), 0.12)
    nodes = mesh.nodes - [0.052, 0.04, 0.01]
    inside = (np.abs(nodes[mesh.tets].mean(axis=1) - [0.028, 0.0, 0.04]) < 0.02).all(axis=1)
    body = hold(TetMesh(nodes, mesh.tets, 1 + inside), nodes[:, 0] < -0.01)
    silicone = Material("neo-hookean", request.param * 21717.95, 0.353034483)
    laws = Elasticity(silicone, {2: silicone.replace_constants(100 * silicone.young)})
    weight = Gravity((-1.0, 0.0, 0.0), -np.inf, 1104.375, 997.0)
    loads = build_posture(np.array([0.0, 0.0, -1.0]), np.array([-1.0, 0.0, 0.075]))
    fields = Fem(body, (laws, Held(), weight), device="cpu").deform(loads).displacement
    faces, floats = find_boundary_faces(mesh.tets[inside]), locate(body.mesh, FLOATS).interpolate(fields)
    write_scan(folder, "initial", FLOATS, nodes, faces, mesh.tets)
    for name, field, moved in zip("abc", fields, floats, strict=True):
        write_scan(folder, name, FLOATS + moved, nodes + field, faces)
    return folder, request.param, 1e3 * np.linalg.norm((fields[2] - fields[1])[np.unique(faces)].mean(axis=0))


def test_errors_of_predictions_follow_from_the_stiffness(phantom, tmp_path):
    folder, share, motion = phantom
    assert main(["phantom", str(folder), "--device", "cpu", "--out", str(tmp_path / "out.json")]) == 0
    found = json.loads((tmp_path / "out.json").read_text())
    measured, still, level, fitted = (row for row in found["rows"] if row["motion"] == "b to c")
    assert measured["shift"] == pytest.approx(motion, rel=0.02) and max(found["residuals"].values()) < 1e-6
    assert still["centroid"] == pytest.approx(measured["shift"]) and 0.0 < still["surface"] < motion
    assert level["centroid"] == pytest.approx((1.0 - share) * motion, rel=0.1, abs=0.02)
    assert max(fitted["centroid"], fitted["surface"], fitted["markers"]) < 0.03 * motion


def test_missing_body_is_reported_after_measured_motion(phantom, capsys):
    (phantom[0] / BODY).unlink()
    assert main(["phantom", str(phantom[0])]) == 2
    printed = capsys.readouterr()
    assert "| b to c | measured |" in printed.out and "ask the authors" in printed.err
    (phantom[0] / list_files("a")[0]).unlink()
    assert main(["phantom", str(phantom[0])]) == 2 and "_a.mrk.json is missing (2 files" in capsys.readouterr().err
