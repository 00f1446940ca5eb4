"""Script for a published liver data set, tested with a box in a folder of that form."""

import importlib.util
import sys
from pathlib import Path

import meshio
import numpy as np
import pytest
from conftest import make_box
from scipy.sparse import coo_matrix, save_npz
from scipy.sparse.linalg import spsolve

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "liver_sequences.py"
YOUNG, POISSON, CLOUDS = 4500.0, 0.45, 4


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("liver_sequences", SCRIPT)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def stiffness_of(nodes, tets):
    """Of linear tetrahedra, by the textbook: B^T D B volume."""
    lam, mu = YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON)), YOUNG / (2 * (1 + POISSON))
    law = np.diag([2 * mu] * 3 + [mu] * 3)
    law[:3, :3] += lam
    corner = nodes[tets]
    edges = corner[:, 1:] - corner[:, :1]
    inverse = np.linalg.inv(edges)
    gradient = np.concatenate([-inverse.sum(axis=2)[:, None], inverse.transpose(0, 2, 1)], axis=1)
    strain = np.zeros((len(tets), 6, 4, 3))
    for row, (i, j) in enumerate([(0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0)]):
        strain[:, row, :, i] += gradient[..., j]
        if i != j:
            strain[:, row, :, j] += gradient[..., i]
    strain = strain.reshape(-1, 6, 12)
    blocks = np.einsum("tai,ab,tbj,t->tij", strain, law, strain, np.abs(np.linalg.det(edges)) / 6.0)
    number = (3 * tets[:, :, None] + np.arange(3)).reshape(-1, 12)
    rows, columns = np.repeat(number, 12, axis=1).ravel(), np.tile(number, 12).ravel()
    return coo_matrix((blocks.ravel(), (rows, columns)), shape=(3 * len(nodes),) * 2).tocsc()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A box that is held but on its top, pulled on four vertices: both meshes are the same."""
    folder, body = tmp_path_factory.mktemp("liver"), make_box(cells=(7, 7, 4), spacing=1e-2, opening=0.03)
    nodes, tets = body.mesh.nodes, body.mesh.tets
    held = np.flatnonzero(nodes[:, 2] < -0.035)
    stiffness = stiffness_of(nodes, tets)
    for mesh in ("default", "remeshed"):
        base = folder / f"mesh-{mesh}"
        base.mkdir()
        meshio.write(base / "liver.msh", meshio.Mesh(nodes, [("tetra", tets)]), file_format="gmsh22", binary=False)
        np.save(base / "dirichlet-vertices.npy", held)
        top = np.flatnonzero(nodes[:, 2] > -1e-9)
        triangles = body.mesh.surface[np.isin(body.mesh.surface, top).all(axis=1)]
        np.save(base / "matching-triangles.npy", triangles)
        save_npz(base / "stiffness_matrix.npz", stiffness)
    random, sequence = np.random.default_rng(0), folder / "sequences" / "linear" / "s1"
    (sequence / "pointclouds").mkdir(parents=True)
    patch = top[np.linalg.norm(nodes[top, :2], axis=1) < 0.022]
    for mesh in ("default", "remeshed"):
        np.save(sequence / f"forces-vertices-{mesh}.npy", patch)
    free = np.setdiff1d(np.arange(3 * len(nodes)), (3 * held[:, None] + np.arange(3)).ravel())
    forces, places = [], []
    for number in range(CLOUDS):
        force = np.zeros_like(nodes)
        force[patch[:4]] = [0.002 * number, 0.001, 0.004 + 0.002 * number]
        motion = np.zeros(3 * len(nodes))
        motion[free] = spsolve(stiffness[free][:, free], force.ravel()[free])
        place = nodes + motion.reshape(-1, 3)
        weights = random.dirichlet(np.ones(3), 200)
        some = triangles[random.integers(len(triangles), size=200)]
        np.savetxt(sequence / "pointclouds" / f"pc{number:02d}.txt", np.einsum("nc,nci->ni", weights, place[some]))
        forces.append(force.sum(axis=0))
        places.append(place)
    np.save(sequence / "true-forces.npy", forces)
    np.save(sequence / "positions-default.npy", places)
    return folder


def test_forces_and_positions_are_estimated_from_point_clouds(script, folder, capsys):
    assert script.list_sequences(folder) == ["linear/s1"] and script.main([str(folder)]) == 0
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("| linear"))
    cells = line.split("|")
    force, position = float(cells[2].split()[0]), float(cells[4].split(",")[0])
    assert force < 12.0 and position < 0.1
    assert "0.8 - 1.2 s" in cells[6]


def test_folder_without_sequences_is_rejected(script, tmp_path, folder, capsys):
    assert script.main([str(tmp_path)]) == 2 and "holds no sequences" in capsys.readouterr().err
    assert script.main([str(folder), "--sequences", "linear/s9"]) == 2
    assert "Give the folder data/liver" in capsys.readouterr().err
